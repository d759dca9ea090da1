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

MEAN_AP_WEIGHT = 5


@dataclass
class SubsetScores:
    """Scores of one part of an evaluation: everything, a distance bin, a scene tag or a speed class. Fractions of 1."""

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
        return _mean_defined(self.errors)

    @property
    def nds(self) -> float:
        """nuScenes detection score: (5 mAP + sum of max(0, 1 - error)) / 10."""
        total = MEAN_AP_WEIGHT * self.mean_ap + np.maximum(0.0, 1.0 - self.mean_errors).sum()
        return float(total / (MEAN_AP_WEIGHT + len(ERRORS)))

    def headline(self) -> dict[str, float]:
        """mAP, NDS and the five mean errors."""
        errors = zip(ERRORS, self.mean_errors.tolist(), strict=True)
        return {"mAP": self.mean_ap, "NDS": self.nds} | {f"m{name}": value for name, value in errors}

    def present_means(self) -> dict[str, float | None]:
        """`mAP_present`, `mATE_present` ...: the means over those classes alone that have ground truth in this part.

        They are what to read where most classes cannot occur, as in a speed class: cones and signs stand still, so
        above 0.5 m/s they take the mAP over all 12 classes down whatever the detector does, and their errors of 1
        take the mean errors towards 1. None where no such class is there. A class that is there but never reaches
        recall 0.1 keeps the official error of 1, which for velocity (1 m/s) may flatter: read it beside the AP.
        """
        present = self.num_gt > 0
        values = np.concatenate([_mean_defined(self.class_ap[present, None]), _mean_defined(self.errors[present])])
        names = ("AP", *ERRORS)
        return {f"m{name}_present": _number(value) for name, value in zip(names, values, strict=True)}

    def as_dict(self) -> dict[str, object]:
        """Plain numbers for JSON: mAP, NDS, the mean errors and `classes`; NaN becomes None."""
        classes = {}
        for row, name in enumerate(CLASSES):
            values = {"AP": _number(self.class_ap[row])}
            values |= {
                f"AP@{threshold}": _number(value)
                for threshold, value in zip(DISTANCE_THRESHOLDS_M, self.ap[row], strict=True)
            }
            values |= {error: _number(value) for error, value in zip(ERRORS, self.errors[row], strict=True)}
            classes[name] = values | {"num_gt": int(self.num_gt[row])}
        return {name: _number(value) for name, value in self.headline().items()} | {"classes": classes}


@dataclass
class DetectionScores:
    """An evaluation: over everything, by distance bin (`"0-25"` ...), scene tag and speed class (`"0.5-10"` ...)."""

    overall: SubsetScores
    ranges: dict[str, SubsetScores]  # empty where not asked for
    tags: dict[str, SubsetScores]  # empty where not asked for
    speeds: dict[str, SubsetScores]  # empty where not asked for
    truth_kept: Array  # [k] bool, ground truth that survives the official filters
    predictions_kept: Array  # [n] bool

    def as_dict(self) -> dict[str, object]:
        """The content of metrics.json: fractions of 1, None where a number is undefined.

        A part counts a class without ground truth as the official score does (AP 0, errors 1); entries of `speeds`
        also hold the means over the classes that are there, see `SubsetScores.present_means`.
        """
        return self.overall.as_dict() | {
            "ranges": {name: scores.as_dict() for name, scores in self.ranges.items()},
            "tags": {name: scores.as_dict() for name, scores in self.tags.items()},
            "speeds": {name: scores.as_dict() | scores.present_means() for name, scores in self.speeds.items()},
        }


def _mean_defined(
    values: Array,  # [classes, m]
) -> Array:
    """Mean over the classes of what is not NaN, NaN where nothing is: [m]."""
    defined = ~np.isnan(values)
    counts = defined.sum(axis=0)
    return np.where(counts > 0, np.where(defined, values, 0.0).sum(axis=0) / np.maximum(counts, 1), np.nan)


def _number(value: float) -> float | None:
    return None if np.isnan(value) else float(value)
