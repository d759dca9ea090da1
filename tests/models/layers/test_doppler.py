"""Radial velocities around cells, and what they make of predicted ones."""

import pytest
import torch
import torch.nn.functional as F

from src.geometry.bev_grid import BEVGrid
from src.models.layers.doppler import Doppler
from tests.models.moving import bda

GRID = BEVGrid(cells=(12, 16), cell_m=0.8, centre_m=(8.0, 0.0), z_range_m=(-3.0, 5.0))


def points_at(*rows: tuple[float, ...]) -> torch.Tensor:
    """Points at cell centres from row, col, vx, vy."""
    t = torch.tensor(rows).reshape(-1, 4)
    return torch.cat([GRID.centre_of(t[:, :2]), torch.ones(len(t), 2), t[:, 2:], 0.1 * torch.ones(len(t), 1)], dim=1)


def cell(sample: int, row: int, col: int) -> int:
    return (sample * 12 + row) * 16 + col


def test_by_hand() -> None:
    """A cell sees standing points of its own and one mover two cells on: by speed, the mover decides."""
    points = points_at((5, 7, 0.1, 0.0), (5, 7, 0.0, 0.1), (5, 9, 30.0, -4.0), (5, 7, -7.0, 1.0), (99, 0, 50.0, 0.0))
    doppler = Doppler.measure(points, torch.tensor([0, 0, 0, 1, 1]), 2, GRID)
    fast = (30.0**2 + 4.0**2) ** 0.5
    # Two passes reach a cell 9 times in itself (3 ways along each axis) and 3 times two columns on.
    total = 2 * 9 * 0.1 + 3 * fast
    mean = torch.tensor([3 * fast * 30 + 9 * 0.1 * 0.1, -3 * fast * 4 + 9 * 0.1 * 0.1]) / total
    found = doppler.velocities[[cell(0, 5, 7), cell(1, 3, 5), cell(0, 1, 1)]]
    torch.testing.assert_close(found, torch.stack([mean, torch.tensor([-7.0, 1.0]), torch.zeros(2)]))
    assert doppler.seen[[cell(0, 5, 7), cell(1, 3, 5)]].all()
    assert int(doppler.seen[: 12 * 16].sum()) == 5 * 7 and int(doppler.seen[12 * 16 :].sum()) == 25


def test_only_the_radial_part_is_imposed_and_only_near_points() -> None:
    """Moving along the line from the points' velocity; standing: along the line of sight from the origin."""
    doppler = Doppler.measure(points_at((2, 2, 20.0, -20.0), (9, 14, 0.2, 0.1)), torch.tensor([0, 0]), 1, GRID)
    cells = torch.tensor([cell(0, 2, 2), cell(0, 9, 14), cell(0, 5, 8)])
    said = torch.tensor([[9.0, 1.0], [3.0, -5.0], [4.0, 4.0]], requires_grad=True)
    found = doppler.impose(said, cells)
    torch.testing.assert_close(found[0], torch.tensor([20.0, -20.0]) + 5.0)  # across it: (5, 5)
    sight = F.normalize(GRID.centre_of(torch.tensor([9.0, 14.0])), dim=0)
    across = torch.stack([-sight[1], sight[0]])
    expected = (torch.tensor([3.0, -5.0]) @ across) * across + (torch.tensor([0.2, 0.1]) @ sight) * sight
    torch.testing.assert_close(found[1], expected)
    assert torch.equal(found[2], said[2])
    (gradient,) = torch.autograd.grad(found[0] @ torch.tensor([1.0, -1.0]), said)
    assert gradient.abs().max() < 1e-6  # nothing is learnt along the measured direction


@pytest.mark.parametrize("points", [points_at(), points_at((99, 0, 5.0, 5.0))], ids=["none", "outside the grid"])
def test_without_points_nothing_changes(points: torch.Tensor) -> None:
    doppler = Doppler.measure(points, torch.zeros(len(points)).long(), 1, GRID)
    said = torch.randn(9, 2)
    assert torch.equal(doppler.impose(said, torch.arange(9)), said) and not doppler.seen.any()


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
    before = Doppler.measure(points, torch.zeros(40).long(), 1, grid).impose(said, torch.arange(144))
    after = Doppler.measure(turned, torch.zeros(40).long(), 1, grid).impose(said @ linear.T, col * 12 + 11 - row)
    torch.testing.assert_close(after, before @ linear.T, atol=1e-3, rtol=1e-4)
