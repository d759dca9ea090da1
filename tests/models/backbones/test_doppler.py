"""Radial velocities around the cells of the radar's map."""

import torch

from src.geometry.bev_grid import BEVGrid
from src.models.backbones.doppler import doppler_map
from src.ops.sites import Sites
from src.structures.sparse_bev import SparseBEV
from tests.models.moving import bda

GRID = BEVGrid(cells=(12, 16), cell_m=0.8, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))
CELLS = torch.tensor([[0, 5, 7], [0, 5, 8], [0, 9, 2], [1, 5, 7]])


def radar_map() -> SparseBEV:
    sites, _ = Sites.from_indices(CELLS, (2, *GRID.cells))
    return SparseBEV(sites, torch.zeros(len(sites), 4))


def points_at(*rows: tuple[int, int, float, float]) -> torch.Tensor:
    """Points at cell centres from row, col, vx, vy."""
    t = torch.tensor(rows).reshape(-1, 4)
    return torch.cat([GRID.centre_of(t[:, :2]), torch.ones(len(t), 2), t[:, 2:], 0.1 * torch.ones(len(t), 1)], dim=1)


def test_by_hand() -> None:
    """The first cell sees its standing points and the mover beside it: by speed, that decides."""
    points = points_at((5, 7, 0.1, 0.0), (5, 7, 0.0, 0.1), (5, 8, 30.0, -4.0), (5, 7, -7.0, 1.0), (0, 0, 50.0, 0.0))
    found = doppler_map(radar_map(), GRID, points, torch.tensor([0, 0, 0, 1, 1])).features
    fast = (30.0**2 + 4.0**2) ** 0.5
    total = 2 * 0.1 + 2 * 0.1 + 2 * fast  # two passes over two neighbours: each sees either twice
    mean = torch.tensor([2 * fast * 30 + 2 * 0.1 * 0.1, -2 * fast * 4 + 2 * 0.1 * 0.1]) / total
    torch.testing.assert_close(found, torch.stack([mean, mean, torch.zeros(2), torch.tensor([-7.0, 1.0])]))


def test_nothing_near_or_nothing_at_all_is_zero() -> None:
    still = points_at((5, 7, 1e-4, 0.0))
    assert doppler_map(radar_map(), GRID, still, torch.zeros(1).long()).features.norm(dim=1).max() < 1e-4
    assert not doppler_map(radar_map(), GRID, points_at(), torch.zeros(0).long()).features.any()


def test_it_turns_with_the_augmentation() -> None:
    """A quarter turn maps cells to cells: the grid of 12 x 12 cells around its centre."""
    grid = BEVGrid(cells=(12, 12), cell_m=0.8, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))
    generator = torch.Generator().manual_seed(0)
    points = (torch.rand(40, 7, generator=generator) - 0.5) * torch.tensor([9.6, 9.6, 2, 9, 60, 60, 1])
    cells = torch.cat([torch.zeros(40, 1).long(), grid.cell_of(points[:, :2])], dim=1)
    linear = bda(torch.pi / 2)[:2, :2]
    turned = torch.cat([points[:, :2] @ linear.T, points[:, 2:4], points[:, 4:6] @ linear.T, points[:, 6:]], dim=1)
    turned_cells = torch.stack([cells[:, 0], cells[:, 2], 11 - cells[:, 1]], dim=1)  # row <- col, col <- 11 - row
    found = []
    for cloud, own in ((points, cells), (turned, turned_cells)):
        sites, rows = Sites.unique(own, (1, 12, 12))
        bev = SparseBEV(sites, torch.zeros(len(sites), 1))
        found.append(doppler_map(bev, grid, cloud, torch.zeros(40).long()).features[rows])
    torch.testing.assert_close(found[1], found[0] @ linear.T, atol=1e-4, rtol=1e-4)
