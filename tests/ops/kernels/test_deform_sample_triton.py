import pytest
import torch

from src.geometry.bev_grid import BEVGrid
from src.ops.backend import implementation
from src.ops.deform_sample import attend_cells_reference, attend_views_reference
from src.ops.sites import Sites

GRID = BEVGrid(cells=(12, 16), cell_m=0.8, centre_m=(3.0, -1.0), z_range_m=(-3.0, 5.0))


@pytest.mark.parametrize(("sites", "queries", "dtype"), [
    (90, 0, torch.float32), (90, 12, torch.float32), (90, 12, torch.bfloat16), (1, 5, torch.float32),
])  # fmt: skip
def test_sums_of_cells(device, sites, queries, dtype):
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


@pytest.mark.parametrize(("samples", "queries"), [(2, 5), (1, 0)])
@pytest.mark.parametrize("last", [False, True])
def test_sums_of_views(device, samples, queries, last):
    """Channels first and last in memory; points beyond every edge of the image, and far away."""
    draw = torch.Generator().manual_seed(samples + queries)
    views, heads, points = 3, 2, 4
    images = [torch.randn(samples * views, 6, *size, generator=draw) for size in ((6, 8), (3, 4))]
    if last:
        images = [image.contiguous(memory_format=torch.channels_last) for image in images]
    places = 2.6 * torch.rand(samples * views, queries, points, 2, generator=draw) - 1.3
    places[:, ::4, 0] = -3.0
    weights = torch.rand(samples, queries, heads, views, len(images), points, generator=draw)
    moved = ([image.to(device) for image in images], places.to(device), weights.to(device))
    ours = implementation(attend_views_reference)(*moved).cpu()
    torch.testing.assert_close(ours, attend_views_reference(images, places, weights), rtol=1e-5, atol=1e-5)
