import pytest
import torch

from src.geometry.bev_grid import BEVGrid
from src.ops.cell_keys import cell_centres, cell_centres_reference, cell_keys, cell_keys_reference
from src.ops.sites import Sites


@pytest.mark.parametrize(("count", "samples"), [(0, 0), (1, 1), (600, 3), (300, 300)])
@pytest.mark.parametrize("ndim", [2, 3])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_keys_of_points(device, dtype, ndim, count, samples):
    draw = torch.Generator().manual_seed(count)
    rows = 12 * torch.rand(count, ndim + 2, generator=draw) - 2
    rows[::7] = (0.3 * torch.randint(0, 30, (len(rows[::7]), 1), generator=draw)).float()  # borders of cells
    rows[3:4, 0], rows[5:6, 1] = torch.nan, torch.inf
    owners = torch.randint(0, 4, (samples,), generator=draw)  # 3 is none
    valid = rows[:, -1] > 0
    grid = ((-1.2, -0.6, 0.3)[:ndim], (0.3, 0.6, 0.9)[:ndim], (3, 7, 20, 30)[: ndim + 1])
    for known in (None, valid):
        for behind in (0, 1):
            given = (*grid, dtype, behind)
            wanted = cell_keys_reference(rows[:, :ndim], owners, known, *given)
            known_there = None if known is None else known.to(device)
            found = cell_keys(rows.to(device)[:, :ndim], owners.to(device), known_there, *given)
            assert torch.equal(found.cpu(), wanted)


@pytest.mark.parametrize("count", [0, 3, 700])
def test_centres_of_keys(device, count):
    grid = BEVGrid(cells=(20, 14), cell_m=0.8, centre_m=(1.0, -2.0), z_range_m=(-3.0, 5.0))
    cells = torch.stack([torch.arange(count) % size for size in (2, 20, 14)], 1)
    keys = Sites((2, 20, 14), cells[:, 0]).keys_of(cells)
    found = cell_centres(keys.to(device), grid)
    torch.testing.assert_close(found.cpu(), cell_centres_reference(keys, grid))
    torch.testing.assert_close(found.cpu(), grid.centre_of(cells[:, 1:]))
