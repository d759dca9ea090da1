import itertools

import pytest
import torch

from src.geometry.voxel_grid import VoxelGrid
from src.ops.ball_query import ball_query
from src.ops.sites import Sites
from tests.ops.maps import random_sites

GRID = VoxelGrid((-2.0, -1.0, 0.0), (4.0, 3.0, 2.0), (0.5, 0.5, 0.25), num_levels=1)
SITES = random_sites((2, *GRID.cells), 500)


def by_hand(features, point, sample, neighbours):
    """Every site of the sample: its distance in voxels along each axis from the voxel of the point decides."""
    cell = [int((p - low) // size) for p, low, size in zip(point, GRID.lower_m, GRID.voxel_m, strict=True)]
    total, weight_sum = torch.zeros(features.shape[1]).double(), 0.0
    for row, (b, z, y, x) in enumerate(SITES.indices().tolist()):
        apart = sum(abs(a - c) for a, c in zip((x, y, z), cell, strict=True))
        if b == sample and apart <= (1 if neighbours == 7 else 0):
            centre = [low + (i + 0.5) * s for low, i, s in zip(GRID.lower_m, (x, y, z), GRID.voxel_m, strict=True)]
            distance = sum((a - c) ** 2 for a, c in zip(point, centre, strict=True)) ** 0.5
            weight = 1 / (0.05 + distance)
            total, weight_sum = total + weight * features[row], weight_sum + weight
    return total / weight_sum if weight_sum else total


@pytest.mark.parametrize("neighbours", [1, 7])
def test_it_equals_a_search_through_all_sites(neighbours):
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(len(SITES), 3, dtype=torch.float64, generator=generator)
    points = torch.rand(40, 3, dtype=torch.float64, generator=generator) * torch.tensor([6.0, 4.0, 2.0])
    points += torch.tensor(GRID.lower_m)
    batch = torch.arange(40) % 2
    found = ball_query(features, SITES, GRID, points, batch, neighbours)
    expected = [by_hand(features, p, b, neighbours) for p, b in zip(points.tolist(), batch.tolist(), strict=True)]
    assert found.any(1).sum() > 10 and (neighbours == 7 or not found.any(1).all())
    torch.testing.assert_close(found, torch.stack(expected))


def test_gradients_reach_features_and_the_point():
    """The offset branch learns through the weights alone; a voxel's own feature does not depend on the place in it."""
    generator = torch.Generator().manual_seed(1)
    cells = SITES.indices()[::100]
    features = torch.randn(len(SITES), 2, dtype=torch.float64, generator=generator, requires_grad=True)
    shift = torch.rand(len(cells), 3, generator=generator) * 0.1 + 0.02
    points = (GRID.centre_of(cells[:, 1:]) + shift).double().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda x, p: ball_query(x, SITES, GRID, p, cells[:, 0], 7), (features, points), atol=1e-6
    )
    alone = ball_query(features, SITES, GRID, points, cells[:, 0], 1)
    assert torch.equal(alone, features[::100])
    assert torch.autograd.grad(alone.sum(), points, allow_unused=True)[0] is None


def test_moving_towards_a_neighbour_brings_its_feature():
    """Along +x the weight of the neighbour at +x rises: the gradient has the sign that the offset must follow."""
    sites, _ = Sites.from_indices(torch.tensor([[0, 2, 3, 4], [0, 2, 3, 5]]), (1, *GRID.cells))
    centre = GRID.centre_of(torch.tensor([[2, 3, 4]]))
    point = (centre + torch.tensor([[0.1, 0.0, 0.0]])).requires_grad_()
    value = ball_query(torch.tensor([[0.0], [1.0]]), sites, GRID, point, torch.zeros(1, dtype=torch.int64), 7)
    value.sum().backward()
    assert 0 < value < 0.5 and point.grad[0, 0] > 0.1 and point.grad[0, 1:].abs().max() < 1e-6


@pytest.mark.parametrize("neighbours", [1, 7])
def test_nothing_there(neighbours):
    """Outside the grid, also just beside an active voxel, in empty space and in an empty volume."""
    sites, _ = Sites.from_indices(torch.tensor(list(itertools.product([0], [0], range(8), [0]))), (1, *GRID.cells))
    outside = torch.tensor([[-2.01, 1.0, 0.1], [0.0, 0.0, 5.0], [float("nan"), 0.0, 0.0], [3.0, 2.0, 1.5]])
    batch, ones = torch.zeros(4, dtype=torch.int64), torch.ones(len(sites), 2)
    assert not ball_query(ones, sites, GRID, outside, batch, neighbours).any()
    nothing = Sites(sites.shape, sites.keys[:0])
    features = torch.zeros(0, 2, requires_grad=True)
    out = ball_query(features, nothing, GRID, outside, batch, neighbours)
    assert out.shape == (4, 2) and not out.any()
    out.sum().backward()
    assert ball_query(ones, sites, GRID, outside[:0], batch[:0], neighbours).shape == (0, 2)


def test_wrong_arguments_are_named():
    points, batch = torch.zeros(1, 3), torch.zeros(1, dtype=torch.int64)
    features = torch.zeros(len(SITES), 2)
    with pytest.raises(ValueError, match="neighbours=27: must be 1 or 7"):
        ball_query(features, SITES, GRID, points, batch, 27)
    with pytest.raises(ValueError, match=r"but the grid has \(4, 4, 6\)"):
        other = VoxelGrid(GRID.lower_m, GRID.upper_m, (1.0, 1.0, 0.5), 1)
        ball_query(features, SITES, other, points, batch, 7)
