"""BEV paths, maps and random cells for their tests."""

import torch

from src.geometry.bev_grid import BEVGrid
from src.models.horizon3d.bev_path import BEVPath, BEVPathConfig
from src.ops.sites import Sites
from src.structures.sparse_bev import SparseBEV

C = 8
GRID = BEVGrid(cells=(96, 128), cell_m=0.8, centre_m=(2.0, -1.0), z_range_m=(-3.0, 5.0))
TINY = BEVGrid(cells=(5, 6), cell_m=1.0, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))
FULL = BEVGrid(cells=(384, 384), cell_m=0.8, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))


def make_path(grid=GRID, channels=C, **changes):
    values = {
        "num_frames": 8,
        "memory_threshold": 0.1,
        "max_cells_per_frame": 4096,
        "velocity_compensation": True,
        "spatial_dilation": False,
    }
    torch.manual_seed(0)
    return BEVPath(BEVPathConfig(**(values | changes)), channels, grid)


def bev_of(cells, grid=GRID, features=None, batch_size=1):
    """A map on distinct cells [n, 3] (batch, row, col), in any order; features default to the row's number."""
    sites, order = Sites.from_indices(cells, (batch_size, grid.rows, grid.cols))
    if features is None:
        features = torch.arange(len(cells), dtype=torch.float32)[:, None].expand(-1, C)
    return SparseBEV(sites, features[order]), order


def rows_at(bev, cells):
    """Features of a map at cells [n, 3] (batch, row, col), zero where no site is active."""
    batch, row, col = cells.unbind(1)
    return bev.to_dense()[batch, :, row, col]


def random_cells(count, batch_size, grid, seed):
    generator = torch.Generator().manual_seed(seed)
    numbers = torch.randperm(batch_size * grid.rows * grid.cols, generator=generator)[:count].sort().values
    cells = torch.stack([numbers // (grid.rows * grid.cols), numbers // grid.cols % grid.rows, numbers % grid.cols], 1)
    return cells, torch.randn(count, 2, generator=generator), torch.randn(count, C, generator=generator)
