import math

import pytest
import torch

from src.ops.voxelize import voxelize

LOWER, SIZE, SHAPE = (-1.0, -1.0, -0.5), (0.5, 0.5, 1.0), (2, 3, 4)  # x in [-1, 1), y in [-1, 0.5), z in [-0.5, 1.5)


def test_means_and_counts_by_hand():
    coordinates = torch.tensor([[-1.0, -1.0, -0.5], [-0.6, -0.9, 0.4], [0.9, 0.4, 1.4], [0.9, 0.4, 1.4]])
    points = torch.tensor([[1.0, 10.0], [3.0, 20.0], [5.0, 5.0], [6.0, 7.0]])
    sites, means, counts = voxelize(points, coordinates, torch.tensor([0, 0, 0, 1]), LOWER, SIZE, SHAPE, 2)
    assert sites.shape == (2, 2, 3, 4)
    assert sites.indices().tolist() == [[0, 0, 0, 0], [0, 1, 2, 3], [1, 1, 2, 3]]
    assert means.tolist() == [[2.0, 15.0], [5.0, 5.0], [6.0, 7.0]]
    assert counts.tolist() == [2, 1, 1]


def test_points_outside_and_not_finite_are_left_out():
    inside = [0.0, 0.0, 0.0]
    outside = [[1.0, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 1.5], [-1.01, 0.0, 0.0], [math.nan, 0.0, 0.0]]
    coordinates = torch.tensor([inside, *outside, [0.0, math.inf, 0.0]])
    sites, means, counts = voxelize(
        torch.ones(7, 1), coordinates, torch.zeros(7, dtype=torch.int64), LOWER, SIZE, SHAPE, 1
    )
    assert sites.indices().tolist() == [[0, 0, 2, 2]] and counts.tolist() == [1] and means.tolist() == [[1.0]]


def test_two_axes_and_order_of_points():
    torch.manual_seed(0)
    coordinates, batch, points = torch.rand(200, 2) * 4, torch.randint(0, 3, (200,)), torch.randn(200, 5)
    arguments = ((0.0, 0.0), (0.8, 0.8), (5, 5), 3)
    sites, means, counts = voxelize(points, coordinates, batch, *arguments)
    cells = torch.cat([batch[:, None], (coordinates.flip(1) / 0.8).floor().long()], 1)
    for row, cell in enumerate(sites.indices()):
        mine = (cells == cell).all(1)
        assert counts[row] == mine.sum()
        torch.testing.assert_close(means[row], points[mine].mean(0))
    shuffle = torch.randperm(200)
    again = voxelize(points[shuffle], coordinates[shuffle], batch[shuffle], *arguments)
    assert torch.equal(again[0].keys, sites.keys) and torch.equal(again[2], counts)
    torch.testing.assert_close(again[1], means)


def test_guard_keeps_the_densest_voxels_of_each_sample():
    x = torch.tensor([0.1, 1.1, 1.2, 2.1, 3.1, 3.2, 3.3, 0.1])
    batch = torch.tensor([0, 0, 0, 0, 0, 0, 0, 1])
    coordinates = torch.stack([x, torch.zeros(8)], 1)
    sites, means, counts = voxelize(x[:, None], coordinates, batch, (0.0, 0.0), (1.0, 1.0), (1, 4), 2, max_voxels=3)
    assert sites.indices().tolist() == [[0, 0, 0], [0, 0, 1], [0, 0, 3], [1, 0, 0]]  # tie of 1: the lower index stays
    assert counts.tolist() == [1, 2, 3, 1]
    torch.testing.assert_close(means.squeeze(1), torch.tensor([0.1, 1.15, 3.2, 0.1]))


def test_no_points_and_wrong_shapes():
    sites, means, counts = voxelize(
        torch.zeros(0, 7), torch.zeros(0, 3), torch.zeros(0, dtype=torch.int64), LOWER, SIZE, SHAPE, 2
    )
    assert len(sites) == len(counts) == 0 and means.shape == (0, 7)
    with pytest.raises(ValueError, match=r"coordinates \[4, 3\]"):
        voxelize(torch.zeros(4, 7), torch.zeros(4, 2), torch.zeros(4, dtype=torch.int64), LOWER, SIZE, SHAPE, 2)
    with pytest.raises(ValueError, match="expected 3 values"):
        voxelize(torch.zeros(4, 7), torch.zeros(4, 3), torch.zeros(4, dtype=torch.int64), LOWER[:2], SIZE, SHAPE, 2)


def test_means_stay_float32_under_autocast():
    with torch.autocast("cpu", dtype=torch.bfloat16):
        means = voxelize(
            torch.full((3, 1), 149.9), torch.zeros(3, 3), torch.zeros(3, dtype=torch.int64), LOWER, SIZE, SHAPE, 1
        )[1]
    assert means.dtype == torch.float32
    torch.testing.assert_close(means, torch.tensor([[149.9]]))
