"""The numbers of a detection evaluation: what is reported, stored and printed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
class PartScores:
    """Scores of one part of an evaluation: everything, a distance bin, a scene tag or a speed class. Fractions of 1.

    All may have leading axes, of evaluations that were made alike.
    """

    thresholds_m: Sequence[float]  # T, of the protocol
    num_gt: Array  # [..., 12] int64, ground-truth boxes after the filters
    ap: Array  # [..., 12, T] by class and distance threshold
    errors: Array  # [..., 12, 5] by class and error, NaN where undefined for the class
    normalized_ap: Array | None = None  # [..., 12, T] of a speed class: see `_score_speed`

    @property
    def class_ap(self) -> Array:
        """AP of each class: mean over the thresholds, [..., 12]."""
        return self.ap.mean(axis=-1)

    @property
    def mean_ap(self) -> Array:
        """mAP: mean over all 12 classes; a class without ground truth counts 0."""
        return self.class_ap.mean(axis=-1)

    @property
    def mean_errors(self) -> Array:
        """mATE, mASE, mAOE, mAVE, mAAE, [..., 5]: mean over the classes for which the error is defined."""
        return _mean_defined(self.errors)

    @property
    def nds(self) -> Array:
        """nuScenes detection score: (5 mAP + sum of max(0, 1 - error)) / 10."""
        total = MEAN_AP_WEIGHT * self.mean_ap + np.maximum(0.0, 1.0 - self.mean_errors).sum(axis=-1)
        return total / (MEAN_AP_WEIGHT + len(ERRORS))

    def headline(self) -> dict[str, Array]:
        """mAP, NDS and the five mean errors."""
        errors = zip(ERRORS, np.moveaxis(self.mean_errors, -1, 0), strict=True)
        return {"mAP": self.mean_ap, "NDS": self.nds} | {f"m{name}": value for name, value in errors}

    def present_means(self) -> dict[str, Array]:
        """`mAP_present`, `mATE_present` ...: the means over those classes alone that have ground truth in this part.

        They are what to read where most classes cannot occur, as in a speed class: cones and signs stand still, so
        above 0.5 m/s they take the mAP over all 12 classes down whatever the detector does, and their errors of 1
        take the mean errors towards 1. NaN where no such class is there. A class that is there but never reaches
        recall 0.1 keeps the official error of 1, which for velocity (1 m/s) may flatter: read it beside the AP.
        `mAP_normalized` is over the same classes.
        """
        values = [self.class_ap[..., None], self.errors, self.normalized_ap.mean(axis=-1)[..., None]]
        means = _mean_defined(np.where(self.num_gt[..., None] > 0, np.concatenate(values, axis=-1), np.nan))
        names = (*(f"m{name}_present" for name in ("AP", *ERRORS)), "mAP_normalized")
        return dict(zip(names, np.moveaxis(means, -1, 0), strict=True))

    def by_class(self) -> dict[str, dict[str, Array]]:
        """AP, its parts by threshold and the errors of each class."""
        names = ("AP", *(f"AP@{threshold}" for threshold in self.thresholds_m), *ERRORS)
        values = np.concatenate([self.class_ap[..., None], self.ap, self.errors], axis=-1)  # [..., 12, 6 + T]
        if self.normalized_ap is not None:
            names = (*names, "AP_normalized")
            values = np.concatenate([values, self.normalized_ap.mean(axis=-1)[..., None]], axis=-1)
        rows = zip(CLASSES, np.moveaxis(values, (-2, -1), (0, 1)), strict=True)
        return {label: dict(zip(names, of_class, strict=True)) for label, of_class in rows}

    def as_dict(self, number: Callable[[Array], object]) -> dict[str, object]:
        """For JSON: mAP, NDS, the mean errors and `classes`, each as `number` says it; of a speed class also the means
        over the classes that are there."""
        values = self.headline() | (self.present_means() if self.normalized_ap is not None else {})
        classes = {label: _each(of_class, number) for label, of_class in self.by_class().items()}
        return _each(values, number) | {"classes": classes}


class SubsetScores(PartScores):
    """The scores of one evaluation."""

    def as_dict(self, number: Callable[[Array], object]) -> dict[str, object]:
        """As the base, with the number of boxes of each class."""
        content = super().as_dict(number)
        for row, values in enumerate(content["classes"].values()):
            values["num_gt"] = int(self.num_gt[row])
        return content


def plain_number(value: Array) -> float | None:
    """For JSON."""
    return None if np.isnan(value) else float(value)


def _each(values: dict[str, Array], number: Callable[[Array], object]) -> dict[str, object]:
    return {name: number(value) for name, value in values.items()}


def _mean_defined(
    values: Array,  # [..., classes, m]
) -> Array:
    """Mean over the classes of what is not NaN, NaN where nothing is: [..., m]."""
    defined = ~np.isnan(values)
    counts = defined.sum(axis=-2)
    return np.where(counts > 0, np.where(defined, values, 0.0).sum(axis=-2) / np.maximum(counts, 1), np.nan)
