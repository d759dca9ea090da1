"""Boxes of many samples as columns, in the global frame: the metric's input and a submission's content."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Array = np.ndarray

COLUMN_WIDTHS = {
    "samples": 1,
    "labels": 1,
    "centers": 3,
    "sizes": 3,
    "rotations": 4,
    "velocities": 2,
    "attributes": 1,
    "scores": 1,
    "num_points": 1,
}
"""Columns of a table of boxes in their order; those of width 1 are vectors."""
INTEGER_COLUMNS = ("samples", "labels", "attributes", "num_points")


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
        for name, width in COLUMN_WIDTHS.items():
            shape, found = (n, width) if width > 1 else (n,), getattr(self, name).shape
            if found != shape:
                raise ValueError(f"DetectionTable.{name} must be {list(shape)}, but got {found}")

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, rows: Array) -> DetectionTable:
        """The boxes at `rows` (a boolean mask or indices), in that order."""
        return DetectionTable(**{name: getattr(self, name)[rows] for name in COLUMN_WIDTHS})

    @staticmethod
    def empty() -> DetectionTable:
        """No boxes."""
        columns = {name: np.zeros((0, width) if width > 1 else 0) for name, width in COLUMN_WIDTHS.items()}
        return DetectionTable(**columns | {name: columns[name].astype(np.int64) for name in INTEGER_COLUMNS})

    @staticmethod
    def concatenate(parts: list[DetectionTable]) -> DetectionTable:
        """Join tables row after row."""
        return DetectionTable(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in COLUMN_WIDTHS})


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
