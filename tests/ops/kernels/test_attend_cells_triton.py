import pytest
import torch

from src.geometry.bev_grid import BEVGrid
from src.ops.backend import implementation
from src.ops.deform_sample import attend_cells_reference
from src.ops.sites import Sites

GRID = BEVGrid(cells=(12, 16), cell_m=0.8, centre_m=(3.0, -1.0), z_range_m=(-3.0, 5.0))


@pytest.mark.parametrize(("sites", "queries", "dtype"), [
    (90, 0, torch.float32), (90, 12, torch.float32), (90, 12, torch.bfloat16), (1, 5, torch.float32),
])  # fmt: skip
def test_sums(device, sites, queries, dtype):
    draw = torch.Generator().manual_seed(sites + queries)
    cells = torch.stack([torch.randint(0, size, (sites,), generator=draw) for size in (2, *GRID.cells)], 1)
    found, _ = Sites.unique(cells, (2, *GRID.cells))
    values = torch.randn(len(found), 4, 5, generator=draw).to(dtype)
    points = torch.rand(queries, 6, 2, generator=draw) * torch.tensor([16.0, 12.0]) - torch.tensor([5.0, 7.0])
    if queries:
        points[0, 0], points[1, 1], points[2, 2] = torch.nan, 1e9, -1e9
    weights, batch = torch.rand(queries, 4, 6, generator=draw), torch.arange(queries) % 2
    table = torch.full((2 * 12 * 16 + 1,), -1).index_copy(0, found.linear(), torch.arange(len(found)))
    inputs = (values, table, points, batch, weights)
    attend = implementation(attend_cells_reference)
    ours = attend(*(tensor.to(device) for tensor in inputs), GRID).cpu()
    torch.testing.assert_close(ours, attend_cells_reference(*inputs, GRID), rtol=1e-5, atol=1e-5)
