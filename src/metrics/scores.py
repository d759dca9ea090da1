"""The numbers of a detection evaluation: what is reported, stored and printed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from src.structures.taxonomy import CLASSES

Array = np.ndarray

DISTANCE_THRESHOLDS_M = (0.5, 1.0, 2.0, 4.0)
"""A match is nearer than this; AP is the mean over the four."""

ERROR_THRESHOLD_M = 2.0
"""True positive errors are read off this threshold's matches."""

ERRORS = ("ATE", "ASE", "AOE", "AVE", "AAE")
"""Translation (m), scale (1 - IoU), orientation (rad), velocity (m/s) and attribute (1 - accuracy) errors."""

CLASS_WITHOUT_ERRORS: dict[str, tuple[str, ...]] = {
    "traffic_cone": ("AOE", "AVE", "AAE"),
    "barrier": ("AVE", "AAE"),
    "animal": ("AAE",),
    "traffic_sign": ("AVE",),
}
"""Errors that are undefined for a class and left out of the means."""

MEAN_AP_WEIGHT = 5


@dataclass
class SubsetScores:
    """Scores of one part of an evaluation: everything, one distance bin or one scene tag. Fractions of 1."""

    num_gt: Array  # [12] int64, ground-truth boxes after the filters
    ap: Array  # [12, 4] by class and distance threshold
    errors: Array  # [12, 5] by class and error, NaN where undefined for the class
    precision: Array  # [12, 4, 101] over recall
    confidence: Array  # [12, 4, 101]
    error_curves: Array  # [12, 5, 101] at 2 m

    @property
    def class_ap(self) -> Array:
        """AP of each class: mean over the four thresholds, [12]."""
        return self.ap.mean(axis=1)

    @property
    def mean_ap(self) -> float:
        """mAP: mean over all 12 classes; a class without ground truth counts 0."""
        return float(self.class_ap.mean())

    @property
    def mean_errors(self) -> Array:
        """mATE, mASE, mAOE, mAVE, mAAE, [5]: mean over the classes for which the error is defined."""
        defined = ~np.isnan(self.errors)
        counts = defined.sum(axis=0)
        sums = np.where(defined, self.errors, 0.0).sum(axis=0)
        return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)

    @property
    def nds(self) -> float:
        """nuScenes detection score: (5 mAP + sum of max(0, 1 - error)) / 10."""
        total = MEAN_AP_WEIGHT * self.mean_ap + np.maximum(0.0, 1.0 - self.mean_errors).sum()
        return float(total / (MEAN_AP_WEIGHT + len(ERRORS)))

    def as_dict(self) -> dict[str, object]:
        """Plain numbers for JSON: mAP, NDS, the mean errors and `classes`; NaN becomes None."""
        result: dict[str, object] = {"mAP": _number(self.mean_ap), "NDS": _number(self.nds)}
        result |= {f"m{name}": _number(value) for name, value in zip(ERRORS, self.mean_errors, strict=True)}
        classes = {}
        for row, name in enumerate(CLASSES):
            values = {"AP": _number(self.class_ap[row])}
            values |= {
                f"AP@{threshold}": _number(value)
                for threshold, value in zip(DISTANCE_THRESHOLDS_M, self.ap[row], strict=True)
            }
            values |= {error: _number(value) for error, value in zip(ERRORS, self.errors[row], strict=True)}
            classes[name] = values | {"num_gt": int(self.num_gt[row])}
        return result | {"classes": classes}


@dataclass
class DetectionScores:
    """An evaluation: over everything, by distance bin (`"0-25"` ...) and by scene tag (`"weather.clear"` ...)."""

    overall: SubsetScores
    ranges: dict[str, SubsetScores]  # empty where not asked for
    tags: dict[str, SubsetScores]  # empty where not asked for
    truth_kept: Array  # [k] bool, ground truth that survives the official filters
    predictions_kept: Array  # [n] bool

    def headline(self) -> dict[str, float]:
        """mAP, NDS and the five mean errors over everything."""
        errors = zip(ERRORS, self.overall.mean_errors.tolist(), strict=True)
        return {"mAP": self.overall.mean_ap, "NDS": self.overall.nds} | {f"m{name}": value for name, value in errors}

    def as_dict(self) -> dict[str, object]:
        """The content of metrics.json: fractions of 1, None where a number is undefined."""
        return self.overall.as_dict() | {
            "ranges": {name: scores.as_dict() for name, scores in self.ranges.items()},
            "tags": {name: scores.as_dict() for name, scores in self.tags.items()},
        }


def _number(value: float) -> float | None:
    return None if np.isnan(value) else float(value)
