"""Which boxes a detection score counts, how near a match must be, and into which distances it is split."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from src.errors import ConfigError
from src.geometry.transforms import quaternion_to_matrix
from src.metrics.filtering import ego_distances, has_points_and_no_rack
from src.metrics.scores import DISTANCE_THRESHOLDS_M, ERROR_THRESHOLD_M
from src.structures.detections import DetectionTable, EvaluationSet
from src.structures.taxonomy import CLASS_RANGE_M, CLASSES

Array = np.ndarray

CLASS_RANGES_M = np.array([CLASS_RANGE_M[name] for name in CLASSES])
"""Of each label."""


@dataclass(kw_only=True)
class Protocol:
    """A configuration of the detection metric."""

    thresholds_m: list[float]  # a match is nearer than this; AP is the mean over them
    error_threshold_m: float  # the one of whose matches errors are read
    ranges_m: list[list[float]]  # [low, high) of the distance bins, in order and without gaps
    region_m: list[list[float]] | None  # [low, high) along x and y of the ego frame; null: by the range of each class

    def __post_init__(self) -> None:
        thresholds = self.thresholds_m
        if not thresholds or sorted({*thresholds}) != list(thresholds) or thresholds[0] <= 0:
            raise ConfigError(f"thresholds_m must be positive and ascending, but got {thresholds}")
        if self.error_threshold_m not in thresholds:
            raise ConfigError(
                f"error_threshold_m={self.error_threshold_m} must be one of thresholds_m, but these are {thresholds}"
            )
        bins = self.ranges_m
        ordered = all(len(ends) == 2 and 0 <= ends[0] < ends[1] for ends in bins)
        if not bins or not ordered or any(low[1] != high[0] for low, high in itertools.pairwise(bins)):
            raise ConfigError(f"ranges_m must be one or more [low, high], in order and without gaps, but got {bins}")
        if self.region_m is not None and (
            len(self.region_m) != 2 or not all(len(ends) == 2 and ends[0] < ends[1] for ends in self.region_m)
        ):
            raise ConfigError(f"region_m must be [[low, high], [low, high]] along x and y, but got {self.region_m}")

    @property
    def range_names(self) -> list[str]:
        """As in `0-25`."""
        return [f"{low:g}-{high:g}" for low, high in self.ranges_m]

    def counted(self, evaluation_set: EvaluationSet, table: DetectionTable) -> Array:
        """Boxes that count, [n] bool: inside, not without points, no cycle inside a bicycle rack.

        The same holds for ground truth and predictions; a prediction that states 0 points is dropped too.
        """
        if self.region_m is None:
            near = ego_distances(evaluation_set, table) < CLASS_RANGES_M[table.labels]
        else:
            offsets = table.centers - evaluation_set.ego_centers[table.samples]
            axes = quaternion_to_matrix(evaluation_set.ego_rotations)[table.samples]  # columns: the ego's in global
            along = np.einsum("nij,ni->nj", axes, offsets)[:, :2]
            low, high = np.array(self.region_m).T
            near = ((along >= low) & (along < high)).all(axis=1)
        return has_points_and_no_rack(evaluation_set, table, near)

    def bins(self, evaluation_set: EvaluationSet, table: DetectionTable) -> Array:
        """Distance bin of each box by its own distance in the ground plane, [n] int64; -1 beyond them all."""
        edges = [self.ranges_m[0][0], *(high for _, high in self.ranges_m)]
        found = np.digitize(ego_distances(evaluation_set, table), edges) - 1
        return np.where(found == len(self.ranges_m), -1, found)


OFFICIAL = Protocol(
    thresholds_m=list(DISTANCE_THRESHOLDS_M),
    error_threshold_m=ERROR_THRESHOLD_M,
    ranges_m=[[0.0, 25.0], [25.0, 50.0], [50.0, 100.0], [100.0, 150.0]],  # our own, after the official filters
    region_m=None,
)
"""Of the devkit (1.2, `detection_cvpr_2024`) but for the distance bins."""
