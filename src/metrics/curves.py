"""Precision, confidence and error curves over recall, and the numbers read off them."""

from __future__ import annotations

import numpy as np

Array = np.ndarray

RECALLS = np.linspace(0, 1, 101)
MIN_PRECISION = 0.1
FIRST_POINT = 11
"""Curve points count from here: above the minimum recall of 0.1."""


def precision_and_confidence(
    ranks: Array,  # [m] int64, ascending: place of each matched prediction among those of its class
    scores: Array,  # [n] of all n predictions of the class, descending
    num_ground_truth: int,
) -> tuple[Array, Array]:
    """Precision and score at the 101 recalls, interpolated linearly, 0 beyond the recall that is reached.

    Recall rises only at a match, so a recall point lies between the prediction just before a match and the match
    itself, or on the last prediction; no other prediction can touch the curve.
    """
    if not len(ranks) or not num_ground_truth:
        return np.zeros(len(RECALLS)), np.zeros(len(RECALLS))
    marked = np.concatenate([ranks - 1, ranks, [len(scores) - 1]])
    marked.sort()
    knots = marked[(np.diff(marked, prepend=-1) > 0) & (marked >= 0)]
    hits = np.searchsorted(ranks, knots, "right").astype(float)
    recall = hits / float(num_ground_truth)
    precision = np.interp(RECALLS, recall, hits / (knots + 1), right=0)
    confidence = np.interp(RECALLS, recall, scores[knots], right=0)
    return precision, confidence


def error_curve(
    errors: Array,  # [m] of the matches by descending score, NaN where undefined
    scores: Array,  # [m] of the matches, descending
    confidence: Array,  # [101]
) -> Array:
    """Running mean of an error over the matches so far, at the curve's scores: [101].

    NaN does not count (0 before the first valid value); all ones where there is no match or no valid value.
    """
    valid = ~np.isnan(errors)
    if not valid.any():
        return np.ones(len(RECALLS))
    sums, counts = np.nancumsum(errors), np.cumsum(valid)
    means = np.divide(sums, counts, out=np.zeros_like(sums), where=counts != 0)
    return np.interp(confidence[::-1], scores[::-1], means[::-1])[::-1]


def average_precision(
    precision: Array,  # [..., 101]
) -> Array:
    """Mean precision above the minimum over the recall points above the minimum, scaled to 0..1: [...]."""
    return np.maximum(precision[..., FIRST_POINT:] - MIN_PRECISION, 0).mean(axis=-1) / (1 - MIN_PRECISION)


def normalized_precision(
    precision: Array,  # [..., 101], 0 beyond the recall that is reached
    count: Array | int,  # [...] ground truth of the part
    total: Array | int,  # [...] that it is taken as
) -> Array:
    """Precision at the same recalls and false positives if the part had `total` objects (Hoiem et al., ECCV 2012).

    TP / (TP + FP) of a part falls with its share of the objects, whatever is detected; this does not.
    """
    found = precision * np.asarray(total)[..., None]
    every = found + (1 - precision) * np.asarray(count)[..., None]
    return np.divide(found, every, out=np.zeros_like(found), where=found > 0)


def mean_error(
    errors: Array,  # [101]
    confidence: Array,  # [101]
) -> float:
    """Mean of an error curve from the first point that counts to the last with a non-zero score, else 1."""
    scored = np.flatnonzero(confidence)
    last = scored[-1] if len(scored) else 0
    return 1.0 if last < FIRST_POINT else float(np.mean(errors[FIRST_POINT : last + 1]))
