"""Nearest neighbours against a literal search."""

import pytest
import torch

from src.ops import nearest_neighbours as module
from src.ops.nearest_neighbours import nearest_neighbours


@pytest.mark.parametrize("pairs", [8_000_000, 50])
def test_neighbours_are_those_of_a_literal_search(pairs, monkeypatch):
    """Also a chunk at a time, in samples of which one is empty and one smaller than k."""
    monkeypatch.setattr(module, "MAX_PAIRS", pairs)
    xy, sample = torch.randn(33, 2, generator=torch.Generator().manual_seed(0)) * 20, torch.tensor([0] * 30 + [2] * 3)
    rows, present = nearest_neighbours(xy, sample, 3, 5)
    for point in range(33):
        others = [row for row in range(33) if row != point and sample[row] == sample[point]]
        wanted = sorted(others, key=lambda row: float((xy[row] - xy[point]).norm()))[:5]
        assert rows[point, present[point]].tolist() == wanted
        assert (rows[point, ~present[point]] == point).all()


@pytest.mark.parametrize("count", [0, 1])
def test_no_point_and_a_lone_one(count):
    rows, present = nearest_neighbours(torch.zeros(count, 2), torch.zeros(count, dtype=torch.int64), 2, 3)
    assert rows.tolist() == [[0, 0, 0]] * count and present.tolist() == [[False] * 3] * count


def test_points_in_one_place_are_neighbours():
    rows, present = nearest_neighbours(torch.zeros(2, 2), torch.zeros(2, dtype=torch.int64), 1, 1)
    assert rows.tolist() == [[1], [0]] and present.all()
