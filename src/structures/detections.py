"""Boxes of many samples as columns, in the global frame: the metric's input and a submission's content."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

Array = np.ndarray

WIDTHS = {"centers": 3, "sizes": 3, "rotations": 4, "velocities": 2}
"""Widths of the columns that are matrices."""
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
        for name in COLUMNS:
            shape, found = _shape(name, len(self.samples)), getattr(self, name).shape
            if found != shape:
                raise ValueError(f"DetectionTable.{name} must be {list(shape)}, but got {found}")

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, rows: Array) -> DetectionTable:
        """The boxes at `rows` (a boolean mask or indices), in that order."""
        return DetectionTable(**{name: getattr(self, name)[rows] for name in COLUMNS})

    @staticmethod
    def empty() -> DetectionTable:
        """No boxes."""
        kinds = {name: np.int64 if name in INTEGER_COLUMNS else np.float64 for name in COLUMNS}
        return DetectionTable(**{name: np.zeros(_shape(name, 0), kind) for name, kind in kinds.items()})

    @staticmethod
    def concatenate(parts: list[DetectionTable]) -> DetectionTable:
        """Join tables row after row."""
        return DetectionTable(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in COLUMNS})


COLUMNS = tuple(field.name for field in fields(DetectionTable))


def _shape(name: str, rows: int) -> tuple[int, ...]:
    return (rows, WIDTHS[name]) if name in WIDTHS else (rows,)


@dataclass
class EvaluationSet:
    """The samples of one split in scoring (table) order, with everything a score needs.

    `ground_truth` holds the 12 classes before any filter, `racks` the bicycle racks (labels are all 0 there).
    Raises ValueError when the columns' lengths disagree.
    """

    tokens: list[str]  # S sample tokens
    ego_centers: Array  # [S, 3] float64 m, global: ego pose of the LIDAR_LEFT key frame
    ego_rotations: Array  # [S, 4] quaternion (w, x, y, z) of that pose, global_from_ego
    scene_tags: list[tuple[str, ...]]  # S: the tags of each sample's scene
    ground_truth: DetectionTable
    racks: DetectionTable
    scenes: Array  # [S] int64, the same number for samples of one scene
    times_s: Array  # [S] float64, of the key frames
    instances: Array  # [k] int64, the same number for annotations of one object

    def __post_init__(self) -> None:
        samples = (len(self.tokens),)
        wanted = {"ego_centers": (*samples, 3), "ego_rotations": (*samples, 4), "scenes": samples, "times_s": samples}
        wanted["instances"] = (len(self.ground_truth),)
        found = {name: getattr(self, name).shape for name in wanted}
        if found != wanted or len(self.scene_tags) != len(self.tokens):
            raise ValueError(
                f"EvaluationSet of {len(self.tokens)} samples: {found} and {len(self.scene_tags)} tag lists do not "
                f"match {wanted}"
            )
        self.index_of = {token: row for row, token in enumerate(self.tokens)}
