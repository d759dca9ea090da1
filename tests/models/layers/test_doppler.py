"""Radial velocities around cells, and what they make of predicted ones."""

import pytest
import torch
import torch.nn.functional as F

from src.geometry.bev_grid import BEVGrid
from src.models.layers.doppler import Doppler
from src.ops.radial_correction import NUM_BINS
from tests.models.moving import bda
from tests.models.radial import MEASURED

GRID = BEVGrid(cells=(12, 16), cell_m=0.8, centre_m=(8.0, 0.0), z_range_m=(-3.0, 5.0))


def points_at(*rows: tuple[float, ...]) -> torch.Tensor:
    """Points at cell centres from row, col, vx, vy."""
    t = torch.tensor(rows).reshape(-1, 4)
    return torch.cat([GRID.centre_of(t[:, :2]), torch.ones(len(t), 2), t[:, 2:], 0.1 * torch.ones(len(t), 1)], dim=1)


def cell(sample: int, row: int, col: int) -> int:
    return (sample * 12 + row) * 16 + col


def test_by_hand() -> None:
    """A cell sees standing points of its own and one mover two cells on, apart from each other."""
    points = points_at((5, 7, 0.2, 0.0), (5, 8, 0.0, 0.1), (5, 9, 30.0, -4.0), (5, 7, -7.0, 1.0), (99, 0, 50.0, 0.0))
    doppler = Doppler.measure(points, torch.tensor([0, 0, 0, 1, 1]), GRID, MEASURED)

    def found(*place: int) -> list[list[float]]:
        rows = (doppler.keys // NUM_BINS == cell(*place)).nonzero().squeeze(1)
        return sorted(doppler.velocities[rows].tolist())

    standing = [9 * 0.2 / (9 + 6), 6 * 0.1 / (9 + 6)]  # weights 3 x 3 in the own cell, 3 x 2 beside it
    assert found(0, 5, 7) == [pytest.approx(standing), pytest.approx([30.0, -4.0])]
    assert found(1, 3, 5) == [pytest.approx([-7.0, 1.0])]
    assert found(0, 1, 1) == found(1, 2, 5) == []
    assert len(torch.unique(doppler.keys // NUM_BINS)) == 5 * 7 + 25


def test_only_the_radial_part_is_imposed_and_only_what_is_near() -> None:
    """Moving: along the measured velocity. Standing: along the line of sight from the origin."""
    points = points_at((2, 2, 20.0, -20.0), (2, 2, 1e-3, 1e-3), (2, 3, -40.0, 40.0), (9, 14, 0.2, 0.1))
    doppler = Doppler.measure(points, torch.zeros(4).long(), GRID, MEASURED)
    here, there, nowhere = cell(0, 2, 2), cell(0, 9, 14), cell(0, 5, 8)
    said = torch.tensor([[19.0, -17.0], [2.0, -1.0], [-20.0, 19.0], [3.0, -5.0], [4.0, 4.0]], requires_grad=True)
    found = doppler.correct(said, torch.tensor([here, here, here, there, nowhere]))
    torch.testing.assert_close(found[0], torch.tensor([21.0, -19.0]))  # (1, 1) across (20, -20) stays
    for row, place, measured in ((1, (2, 2), [1e-3, 1e-3]), (3, (9, 14), [0.2, 0.1])):
        sight = F.normalize(GRID.centre_of(torch.tensor(place)), dim=0)
        across = torch.stack([-sight[1], sight[0]])
        expected = (said[row] @ across) * across + (torch.tensor(measured) @ sight) * sight
        torch.testing.assert_close(found[row], expected)
    assert torch.equal(found[2], said[2])  # 28 m/s the other way is neither 28 nor 0 nor the aliased 57
    assert torch.equal(found[4], said[4])
    (gradient,) = torch.autograd.grad(found.sum(), said)
    assert torch.equal(gradient, torch.ones(5, 2))


@pytest.mark.parametrize("points", [points_at(), points_at((99, 0, 5.0, 5.0))], ids=["none", "outside the grid"])
def test_without_points_nothing_changes(points: torch.Tensor) -> None:
    doppler = Doppler.measure(points, torch.zeros(len(points)).long(), GRID, MEASURED)
    said = torch.randn(9, 2)
    assert torch.equal(doppler.correct(said, torch.arange(9)), said) and len(doppler.keys) == 0
    assert doppler.correct(said[:0], torch.arange(0)).shape == (0, 2)


def test_speeds_beyond_the_bins_are_taken_together() -> None:
    doppler = Doppler.measure(points_at((5, 9, 300.0, 0.0)), torch.zeros(1).long(), GRID, MEASURED)
    assert doppler.correct(torch.tensor([[110.0, 0.0]]), torch.tensor([cell(0, 5, 9)])).tolist() == [[300.0, 0.0]]


def test_it_turns_with_the_augmentation() -> None:
    """A quarter turn maps the cells of a square grid around the origin to cells."""
    grid = BEVGrid(cells=(12, 12), cell_m=0.8, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))
    generator = torch.Generator().manual_seed(0)
    points = (torch.rand(40, 7, generator=generator) - 0.5) * torch.tensor([9.6, 9.6, 2, 9, 60, 60, 1])
    points[::2, 4:6] *= 1e-3  # standing
    linear = bda(torch.pi / 2)[:2, :2]
    turned = torch.cat([points[:, :2] @ linear.T, points[:, 2:4], points[:, 4:6] @ linear.T, points[:, 6:]], dim=1)
    row, col = torch.arange(144) // 12, torch.arange(144) % 12
    said = 20 * torch.randn(144, 2, generator=generator)
    owners = torch.zeros(40).long()
    before = Doppler.measure(points, owners, grid, MEASURED).correct(said, torch.arange(144))
    after = Doppler.measure(turned, owners, grid, MEASURED).correct(said @ linear.T, col * 12 + 11 - row)
    torch.testing.assert_close(after, before @ linear.T, atol=1e-3, rtol=1e-4)
    assert (before != said).any(dim=1).float().mean() > 0.5
