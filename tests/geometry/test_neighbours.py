"""Neighbours against all distances."""

import numpy as np
import pytest

from src.geometry import neighbours
from src.geometry.neighbours import nearest_squared, neighbours_within


def squared_distances(queries, points):
    return ((queries[:, None] - points[None]) ** 2).sum(-1)


@pytest.mark.parametrize("axes", [2, 3])
@pytest.mark.parametrize("radius", [0.3, 2.0, 50.0])
def test_pairs_are_all_that_are_near(axes, radius, monkeypatch):
    monkeypatch.setattr(neighbours, "MAX_PAIRS", 200)
    rng = np.random.default_rng(0)
    queries, points = rng.uniform(-8, 8, (60, axes)), rng.uniform(-5, 11, (90, axes))
    query, point, squared = neighbours_within(queries, points, radius)
    distances = squared_distances(queries, points)
    assert sorted(zip(query.tolist(), point.tolist(), strict=True)) == [
        tuple(pair) for pair in np.argwhere(distances <= radius**2).tolist()
    ]
    np.testing.assert_allclose(squared, distances[query, point])
    assert all(len(column) == 0 for column in neighbours_within(queries[:0], points, radius))


@pytest.mark.parametrize("scale", [0.1, 3.0, 400.0])
def test_the_nearest_is_found_however_far_it_is(scale):
    rng = np.random.default_rng(1)
    queries, points = rng.normal(0, scale, (200, 3)), rng.normal(0, 20, (150, 3))
    np.testing.assert_allclose(nearest_squared(queries, points), squared_distances(queries, points).min(1))
    np.testing.assert_array_equal(nearest_squared(points, points[::-1]), 0)


def test_what_has_no_nearest_is_refused():
    for queries, points in ((np.zeros((1, 3)), np.zeros((0, 3))), (np.full((1, 3), np.nan), np.zeros((1, 3)))):
        with pytest.raises(ValueError, match="at least one"):
            nearest_squared(queries, points)
