"""Ranked predictions, candidate pairs, matches and their errors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from src.errors import DataError
from src.metrics.matching import CandidatePairs, find_pairs, match_greedily
from src.metrics.protocol import Protocol
from src.metrics.scores import ERRORS
from src.structures.detections import DetectionTable, EvaluationSet
from src.structures.taxonomy import CLASSES

Array = np.ndarray

_HALF_TURN_CLASSES = (CLASSES.index("barrier"), CLASSES.index("traffic_sign"))
"""Their front and back look alike: orientation errors have period pi."""


@dataclass
class Ranking:
    """The boxes that count, predictions by class and then by descending score.

    They are named by their rows: a whole table in that order would be copied column by column to read a few.
    """

    evaluation_set: EvaluationSet
    protocol: Protocol
    predictions: DetectionTable  # as in the file, those that do not count among them
    rows: Array  # [n] row of `predictions` at each place of the order
    truth: DetectionTable  # k
    class_starts: Array  # [13] first place of each class, and n
    file_order: Array  # [n] places of the predictions as they stand in the file

    @cached_property
    def samples(self) -> Array:
        """Sample at each place [n]."""
        return self.predictions.samples[self.rows]

    @cached_property
    def scores(self) -> Array:
        """Score at each place [n]."""
        return self.predictions.scores[self.rows]


@dataclass
class Matching:
    """Matches at each of the protocol's T thresholds, by place of the prediction, and the errors of those at its
    error threshold."""

    places: list[Array]  # T x [m] ascending
    ground_truth: list[Array]  # T x [m] row of `Ranking.truth` that the prediction took
    errors: Array  # [m at the error threshold, 5]


@dataclass
class RankedList:
    """What one AP is read from: the predictions of a class, or of several, at one threshold by descending score."""

    label: int  # the class, -1 for several
    threshold: int  # index into the thresholds of the protocol
    places: Array  # [n] in the ranking
    matched: Array  # [m] ascending, which of the n matched
    errors: Array | None  # [m, 5], at the error threshold only


@dataclass
class Part:
    """Some predictions and ground truth that are scored together; members that matched did so with one another."""

    ranking: Ranking
    matching: Matching
    members: Array  # [n] or, by threshold, [T, n] bool over the ranked predictions
    truth_members: Array  # [k] bool over the ground truth that counts

    def lists(self) -> Iterator[RankedList]:
        """One for every threshold and class with a match."""
        protocol = self.ranking.protocol
        for t, matched_places in enumerate(self.matching.places):
            if t == 0 or self.members.ndim == 2:
                members = self.members if self.members.ndim == 1 else self.members[t]
                places = np.flatnonzero(members)
                class_starts = np.searchsorted(places, self.ranking.class_starts)
            chosen = members[matched_places]
            matched = np.searchsorted(places, matched_places[chosen])
            match_starts = np.searchsorted(matched, class_starts)
            at_errors = protocol.thresholds_m[t] == protocol.error_threshold_m
            errors = self.matching.errors[chosen] if at_errors else None
            for c in np.flatnonzero(np.diff(match_starts)):
                begin, of_class = class_starts[c], slice(match_starts[c], match_starts[c + 1])
                yield RankedList(
                    label=int(c),
                    threshold=t,
                    places=places[begin : class_starts[c + 1]],
                    matched=matched[of_class] - begin,
                    errors=None if errors is None else errors[of_class],
                )

    def pooled_lists(self) -> Iterator[RankedList]:
        """One for every threshold over the predictions of all classes; each was matched within its own."""
        for t, matched_places in enumerate(self.matching.places):
            places = np.flatnonzero(self.members if self.members.ndim == 1 else self.members[t])
            places = places[np.argsort(-self.ranking.scores[places], kind="stable")]
            yield RankedList(-1, t, places, np.flatnonzero(np.isin(places, matched_places)), None)


@dataclass
class SpeedPart(Part):
    """The boxes of some speeds; a prediction that matches nothing is a member if it states such a speed."""

    members_by_place: Array  # [T, n] bool: the members that ask for no stated speed, see `_speed_parts`

    @property
    def by_place(self) -> Part:
        """The same ground truth with these members."""
        return Part(self.ranking, self.matching, self.members_by_place, self.truth_members)


def rank_predictions(
    evaluation_set: EvaluationSet,
    protocol: Protocol,
    predictions: DetectionTable,
    kept: Array,  # [all predictions] bool, those that count
    truth: DetectionTable,  # those that count
) -> Ranking:
    """Put the predictions into the order in which they are matched."""
    # Reversed ascending stable order: descending scores, and the later in the file first among equal ones.
    rows = np.flatnonzero(kept)
    order = np.argsort(predictions.scores[rows], kind="stable")[::-1]
    order = order[np.argsort(predictions.labels[rows[order]].astype(np.uint8), kind="stable")]
    class_starts = np.searchsorted(predictions.labels[rows[order]], np.arange(len(CLASSES) + 1))
    return Ranking(evaluation_set, protocol, predictions, rows[order], truth, class_starts, np.argsort(order))


def find_candidates(ranking: Ranking) -> CandidatePairs:
    """Pairs of one sample and class nearer than the largest threshold; rows count within `ranking`."""
    truth, ego_x = ranking.truth, ranking.evaluation_set.ego_centers[:, 0]
    columns = (ranking.predictions.samples, ranking.predictions.labels, ranking.predictions.centers)
    in_file = ranking.rows[ranking.file_order]  # neighbours in the file share a sample, hence memory
    samples, labels, centers = (column[in_file] for column in columns)
    return find_pairs(
        prediction_groups=samples * len(CLASSES) + labels,
        prediction_xy=centers[:, :2],
        prediction_offsets=centers[:, 0] - ego_x[samples],
        prediction_places=ranking.file_order,
        truth_groups=truth.samples * len(CLASSES) + truth.labels,
        truth_xy=truth.centers[:, :2],
        truth_offsets=truth.centers[:, 0] - ego_x[truth.samples],
        num_groups=len(ranking.evaluation_set.tokens) * len(CLASSES),
        radius_m=ranking.protocol.thresholds_m[-1],
    )


def match_predictions(ranking: Ranking, pairs: CandidatePairs) -> Matching:
    """Match at each threshold among `pairs`, and measure the matches at the error threshold.

    Raises DataError when matched ground truth has a size that is not positive, as the official evaluator does.
    """
    places, ground_truth, errors = [], [], np.zeros((0, len(ERRORS)))
    for threshold in ranking.protocol.thresholds_m:
        near = pairs[pairs.distances < threshold]
        matches = near[match_greedily(near, len(ranking.truth))]
        _check_sizes(ranking, matches)
        places.append(matches.predictions)
        ground_truth.append(matches.ground_truth)
        if threshold == ranking.protocol.error_threshold_m:
            errors = _match_errors(ranking, matches)
    return Matching(places, ground_truth, errors)


def _check_sizes(ranking: Ranking, matches: CandidatePairs) -> None:
    truth = ranking.truth
    flat = ~(truth.sizes[matches.ground_truth] > 0).all(axis=1)
    if flat.any():
        row = matches.ground_truth[np.argmax(flat)]
        raise DataError(
            f"ground truth at {truth.centers[row].tolist()} (sample "
            f"{ranking.evaluation_set.tokens[truth.samples[row]]}): size must be positive to be matched, but got "
            f"{truth.sizes[row].tolist()}"
        )


def _match_errors(ranking: Ranking, matches: CandidatePairs) -> Array:
    """The five errors of each match, NaN where the ground truth (or a velocity) leaves one undefined: [m, 5]."""
    predicted = ranking.predictions[ranking.rows[matches.predictions]]
    truth = ranking.truth[matches.ground_truth]
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
