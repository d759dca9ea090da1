"""Greedy matching of predictions to ground truth by centre distance, exact and without a loop over boxes.

The official rule: within one sample and class, predictions go by descending score; each takes the nearest ground truth
that is still free, if that is nearer than the threshold. Ground truth of one group ranks all predictions alike (by
score), so this assignment is the one stable matching, and rounds of proposals find it for all groups at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from src.geometry.neighbours import expand_ranges

Array = np.ndarray


@dataclass
class CandidatePairs:
    """Candidate pairs, ordered by priority of the prediction, then distance, then row of the ground truth."""

    predictions: Array  # [p] int64, place of the prediction in the order of matching
    ground_truth: Array  # [p] int64, row of the ground truth
    distances: Array  # [p] m

    def __len__(self) -> int:
        return len(self.predictions)

    def __getitem__(self, rows: Array) -> CandidatePairs:
        return CandidatePairs(self.predictions[rows], self.ground_truth[rows], self.distances[rows])


def find_pairs(
    prediction_groups: Array,  # [n] int64, boxes of different groups never meet
    prediction_xy: Array,  # [n, 2] m, global
    prediction_offsets: Array,  # [n] m, x relative to the ego
    prediction_places: Array,  # [n] int64, place in the order of matching
    truth_groups: Array,  # [k] int64
    truth_xy: Array,  # [k, 2] m, global
    truth_offsets: Array,  # [k] m
    num_groups: int,
    radius_m: float,
) -> CandidatePairs:
    """Pairs of one group that are nearer than `radius_m`.

    Groups are cut into stripes of x a little wider than the radius, so that a prediction meets only the ground truth
    of three stripes, which lie next to each other in one sorted list.
    """
    if not len(prediction_groups) or not len(truth_groups):
        return CandidatePairs(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    stripe_m = radius_m * 1.0025  # wider than the radius by more than any rounding of x
    low = min(prediction_offsets.min(), truth_offsets.min())
    high = max(prediction_offsets.max(), truth_offsets.max())
    num_stripes = int((high - low) / stripe_m) + 3  # one spare at each end

    def keys(groups: Array, offsets: Array) -> Array:
        return groups * num_stripes + ((offsets - low) / stripe_m).astype(np.int64) + 1

    truth_keys = keys(truth_groups, truth_offsets)
    by_key = np.argsort(truth_keys, kind="stable")
    starts = np.zeros(num_groups * num_stripes + 1, dtype=np.int64)
    np.cumsum(np.bincount(truth_keys, minlength=num_groups * num_stripes), out=starts[1:])
    prediction_keys = keys(prediction_groups, prediction_offsets)
    rows, places = expand_ranges(starts[prediction_keys - 1], starts[prediction_keys + 2])
    truth = by_key[places]
    delta = prediction_xy[rows] - truth_xy[truth]
    distances = np.sqrt(np.vecdot(delta, delta))  # rounds as the official norm does, which decides exact borders
    near = distances < radius_m
    pairs = CandidatePairs(prediction_places[rows[near]], truth[near], distances[near])
    return pairs[np.lexsort((pairs.ground_truth, pairs.distances, pairs.predictions))]


def match_greedily(pairs: CandidatePairs, num_ground_truth: int) -> Array:
    """Rows of `pairs` that become matches, ordered by priority of the prediction: [m] int64.

    Every unmatched prediction proposes to its nearest ground truth that has not refused it; a ground truth keeps the
    proposal of highest priority and refuses the others, until no proposal is left.
    """
    if not len(pairs):
        return np.zeros(0, np.int64)
    first = np.flatnonzero(np.diff(pairs.predictions, prepend=-1))  # first pair of each prediction
    last = np.append(first[1:], len(pairs))
    asked = first.copy()
    nobody = len(first)
    holder = np.full(num_ground_truth, nobody)
    free = np.arange(nobody)
    while len(free):
        wanted = pairs.ground_truth[asked[free]]
        previous = holder[wanted]
        np.minimum.at(holder, wanted, free)
        refused = free[holder[wanted] != free]
        displaced = np.unique(previous[(previous != nobody) & (holder[wanted] != previous)])
        free = np.concatenate([refused, displaced])
        asked[free] += 1
        free = free[asked[free] < last[free]]
    return asked[np.sort(holder[holder != nobody])]
