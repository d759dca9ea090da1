"""Boxes of many samples as columns, in the global frame: the metric's input and a submission's content."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Array = np.ndarray


@dataclass
class DetectionTable:
    """n boxes of many samples; row order is file order, which decides ties as in the devkit.

    Raises ValueError when the columns' lengths or widths disagree.
    """

    samples: Array  # [n] int64, index into EvaluationSet.tokens
    labels: Array  # [n] int64, index into taxonomy.CLASSES
    centers: Array  # [n, 3] float64 m, global frame
    sizes: Array  # [n, 3] float64 m (width, length, height), the file format's order
    rotations: Array  # [n, 4] float64 quaternion (w, x, y, z), global_from_box
    velocities: Array  # [n, 2] float64 m/s, global axes, NaN where unknown
    attributes: Array  # [n] int64, index into taxonomy.ATTRIBUTES, -1 for none
    scores: Array  # [n] float64; zeros for ground truth
    num_points: Array  # [n] int64, lidar + radar; -1 where not stated (predictions)

    def __post_init__(self) -> None:
        n = len(self.samples)
        for name, width in {"centers": 3, "sizes": 3, "rotations": 4, "velocities": 2}.items():
            if getattr(self, name).shape != (n, width):
                raise ValueError(f"DetectionTable.{name} must be [{n}, {width}], but got {getattr(self, name).shape}")
        for name in ("labels", "attributes", "scores", "num_points"):
            if getattr(self, name).shape != (n,):
                raise ValueError(f"DetectionTable.{name} must be [{n}], but got {getattr(self, name).shape}")

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, rows: Array) -> DetectionTable:
        """The boxes at `rows` (a boolean mask or indices), in that order."""
        return DetectionTable(**{name: getattr(self, name)[rows] for name in DetectionTable.__dataclass_fields__})

    @staticmethod
    def empty() -> DetectionTable:
        """No boxes."""
        integers = {name: np.zeros(0, np.int64) for name in ("samples", "labels", "attributes", "num_points")}
        widths = {"centers": 3, "sizes": 3, "rotations": 4, "velocities": 2}
        return DetectionTable(
            **integers, scores=np.zeros(0), **{name: np.zeros((0, width)) for name, width in widths.items()}
        )

    @staticmethod
    def concatenate(parts: list[DetectionTable]) -> DetectionTable:
        """Join tables row after row."""
        names = DetectionTable.__dataclass_fields__
        return DetectionTable(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in names})


@dataclass
class EvaluationSet:
    """The samples of one split in scoring (table) order, with everything a score needs.

    `ground_truth` holds the 12 classes before any filter, `racks` the bicycle racks (labels are all 0 there).
    """

    tokens: list[str]  # S sample tokens
    ego_centers: Array  # [S, 3] float64 m, global: ego pose of the LIDAR_LEFT key frame
    scene_tags: list[tuple[str, ...]]  # S: the tags of each sample's scene
    ground_truth: DetectionTable
    racks: DetectionTable

    def __post_init__(self) -> None:
        if self.ego_centers.shape != (len(self.tokens), 3) or len(self.scene_tags) != len(self.tokens):
            raise ValueError(
                f"EvaluationSet of {len(self.tokens)} samples: ego_centers {self.ego_centers.shape} and "
                f"{len(self.scene_tags)} tag lists do not match"
            )
        self.index_of = {token: row for row, token in enumerate(self.tokens)}
