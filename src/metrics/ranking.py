"""Ranked predictions, candidate pairs, matches and their errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from src.errors import DataError
from src.metrics.matching import CandidatePairs, find_pairs, match_greedily
from src.metrics.scores import DISTANCE_THRESHOLDS_M, ERROR_THRESHOLD_M, ERRORS
from src.structures.detections import DetectionTable, EvaluationSet
from src.structures.taxonomy import CLASSES

Array = np.ndarray

_HALF_TURN_CLASSES = (CLASSES.index("barrier"), CLASSES.index("traffic_sign"))
"""Their front and back look alike: orientation errors have period pi."""


@dataclass
class Ranking:
    """The predictions that count, by class and then by descending score, and the ground truth that counts."""

    evaluation_set: EvaluationSet
    predictions: DetectionTable
    rows: Array  # [n] row in `predictions`
    labels: Array  # [n] ascending
    scores: Array  # [n]
    samples: Array  # [n]
    class_starts: Array  # [13] first place of each class, and n
    truth_rows: Array  # [k] row in the ground truth
    truth_labels: Array  # [k]
    truth_samples: Array  # [k]


@dataclass
class Matching:
    """Matches at every threshold, by place of the prediction, and the errors of those at 2 m."""

    places: list[Array]  # 4 x [m] ascending
    ground_truth: list[Array]  # 4 x [m] row within `Ranking.truth_rows` that the prediction took
    errors: Array  # [m at 2 m, 5]


def rank_predictions(
    evaluation_set: EvaluationSet,
    predictions: DetectionTable,
    kept: Array,  # [n] bool, predictions that count
    truth_kept: Array,  # [k] bool, ground truth that counts
) -> Ranking:
    """Put the predictions that count into the order in which they are matched."""
    rows = np.flatnonzero(kept)
    # Reversed ascending stable order: descending scores, and the later in the file first among equal ones.
    rows = rows[np.argsort(predictions.scores[rows], kind="stable")[::-1]]
    labels = predictions.labels[rows]
    by_class = np.argsort(labels.astype(np.uint8), kind="stable")
    rows, labels = rows[by_class], labels[by_class]
    truth_rows = np.flatnonzero(truth_kept)
    truth = evaluation_set.ground_truth
    return Ranking(
        evaluation_set=evaluation_set,
        predictions=predictions,
        rows=rows,
        labels=labels,
        scores=predictions.scores[rows],
        samples=predictions.samples[rows],
        class_starts=np.searchsorted(labels, np.arange(len(CLASSES) + 1)),
        truth_rows=truth_rows,
        truth_labels=truth.labels[truth_rows],
        truth_samples=truth.samples[truth_rows],
    )


def find_candidates(ranking: Ranking) -> CandidatePairs:
    """Pairs of one sample and class nearer than the largest threshold; rows count within `ranking`."""
    truth, ego_x = ranking.evaluation_set.ground_truth, ranking.evaluation_set.ego_centers[:, 0]
    in_file_order = np.argsort(ranking.rows)  # neighbours in the file share a sample, hence memory
    xy = ranking.predictions.centers[ranking.rows[in_file_order], :2]
    samples = ranking.samples[in_file_order]
    truth_xy = truth.centers[ranking.truth_rows, :2]
    return find_pairs(
        prediction_groups=samples * len(CLASSES) + ranking.labels[in_file_order],
        prediction_xy=xy,
        prediction_offsets=xy[:, 0] - ego_x[samples],
        prediction_places=in_file_order,
        truth_groups=ranking.truth_samples * len(CLASSES) + ranking.truth_labels,
        truth_xy=truth_xy,
        truth_offsets=truth_xy[:, 0] - ego_x[ranking.truth_samples],
        num_groups=len(ranking.evaluation_set.tokens) * len(CLASSES),
        radius_m=max(DISTANCE_THRESHOLDS_M),
    )


def match_predictions(ranking: Ranking, pairs: CandidatePairs) -> Matching:
    """Match at each threshold among `pairs`, and measure the matches at 2 m.

    Raises DataError when matched ground truth has a size that is not positive, as the official evaluator does.
    """
    places, ground_truth, errors = [], [], np.zeros((0, len(ERRORS)))
    for threshold in DISTANCE_THRESHOLDS_M:
        near = pairs[pairs.distances < threshold]
        matches = near[match_greedily(near, len(ranking.truth_rows))]
        _check_sizes(ranking, matches)
        places.append(matches.predictions)
        ground_truth.append(matches.ground_truth)
        if threshold == ERROR_THRESHOLD_M:
            errors = _match_errors(ranking, matches)
    return Matching(places, ground_truth, errors)


def _check_sizes(ranking: Ranking, matches: CandidatePairs) -> None:
    truth, rows = ranking.evaluation_set.ground_truth, ranking.truth_rows[matches.ground_truth]
    flat = ~(truth.sizes[rows] > 0).all(axis=1)
    if flat.any():
        row = rows[np.argmax(flat)]
        raise DataError(
            f"ground truth {row} (sample {ranking.evaluation_set.tokens[truth.samples[row]]}): size must be positive "
            f"to be matched, but got {truth.sizes[row].tolist()}"
        )


def _match_errors(ranking: Ranking, matches: CandidatePairs) -> Array:
    """The five errors of each match, NaN where the ground truth (or a velocity) leaves one undefined: [m, 5]."""
    predicted = ranking.predictions[ranking.rows[matches.predictions]]
    truth = ranking.evaluation_set.ground_truth[ranking.truth_rows[matches.ground_truth]]
    shared = np.minimum(truth.sizes, predicted.sizes).prod(axis=1)
    overlap = shared / (truth.sizes.prod(axis=1) + predicted.sizes.prod(axis=1) - shared)
    period = np.where(np.isin(truth.labels, _HALF_TURN_CLASSES), np.pi, 2 * np.pi)
    turn = (_yaws(truth.rotations) - _yaws(predicted.rotations) + period / 2) % period - period / 2
    wrong_attribute = np.where(truth.attributes < 0, np.nan, (truth.attributes != predicted.attributes).astype(float))
    velocity = np.linalg.norm(predicted.velocities - truth.velocities, axis=1)
    return np.stack([matches.distances, 1 - overlap, np.abs(turn), velocity, wrong_attribute], axis=1)


def _yaws(
    rotations: Array,  # [n, 4] (w, x, y, z)
) -> Array:
    """Heading of the rotated x axis in the ground plane, [n] rad; the quaternion's length cancels."""
    w, x, y, z = rotations.T
    return np.arctan2(2 * (x * y + w * z), w * w + x * x - y * y - z * z)
