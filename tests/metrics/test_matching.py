"""The rounds of proposals against the official rule, spelled out box by box."""

import numpy as np
import pytest

from src.metrics.matching import find_pairs, match_greedily


def greedy_by_rule(groups, xy, truth_groups, truth_xy, order, threshold):
    taken, matches = set(), []
    for place, row in enumerate(order):
        best, nearest = None, np.inf
        for truth in np.flatnonzero(truth_groups == groups[row]):
            distance = np.linalg.norm(xy[row] - truth_xy[truth])
            if truth not in taken and distance < nearest:
                best, nearest = truth, distance
        if nearest < threshold:
            taken.add(best)
            matches.append((place, best))
    return matches


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("spacing", [0.0, 0.5])  # with a grid many distances are exactly equal
def test_matches_follow_the_rule(seed, spacing):
    rng = np.random.default_rng(seed)
    n, k, num_groups = 300, 80, 4
    xy, truth_xy = rng.uniform(-12, 12, (n, 2)), rng.uniform(-12, 12, (k, 2))
    if spacing:
        xy, truth_xy = np.round(xy / spacing) * spacing, np.round(truth_xy / spacing) * spacing
    groups, truth_groups = rng.integers(0, num_groups, n), rng.integers(0, num_groups, k)
    order = rng.permutation(n)
    places = np.argsort(order)
    pairs = find_pairs(groups, xy, xy[:, 0], places, truth_groups, truth_xy, truth_xy[:, 0], num_groups, 4.0)
    for threshold in (0.5, 1.0, 2.0, 4.0):
        near = pairs[pairs.distances < threshold]
        matches = near[match_greedily(near, k)]
        found = list(zip(matches.predictions.tolist(), matches.ground_truth.tolist(), strict=True))
        expected = greedy_by_rule(groups, xy, truth_groups, truth_xy, order, threshold)
        assert found == expected and (len(found) > 20 or threshold < 4)


def test_a_displaced_prediction_takes_its_second_choice():
    # The order is left (place 0), right (place 1): both want truth 0; the second takes truth 1, 3 m away.
    xy = np.array([[0.0, 0.1], [0.0, 0.0]])
    truth = np.array([[0.0, 0.0], [3.0, 0.0]])
    zeros = np.zeros(2, np.int64)
    pairs = find_pairs(zeros, xy, xy[:, 0], np.array([0, 1]), zeros, truth, truth[:, 0], 1, 4.0)
    matches = pairs[match_greedily(pairs, 2)]
    assert matches.predictions.tolist() == [0, 1] and matches.ground_truth.tolist() == [0, 1]


def test_no_candidates():
    none, xy = np.zeros(0, np.int64), np.zeros((0, 2))
    pairs = find_pairs(none, xy, xy[:, 0], none, none, xy, xy[:, 0], 3, 4.0)
    assert len(pairs) == 0 and len(match_greedily(pairs, 0)) == 0
