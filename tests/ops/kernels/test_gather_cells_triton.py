import pytest
import torch

from src.geometry.bev_grid import BEVGrid
from src.ops.gather_cells import gather_cells, gather_cells_reference

GRID = BEVGrid(cells=(24, 20), cell_m=0.8, centre_m=(1.0, -2.0), z_range_m=(-3.0, 5.0))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize(("num", "channels", "count"), [(0, 4, 3), (50, 4, 0), (50, 20, 30)])
def test_cells(device, num, channels, count, dtype):
    draw = torch.Generator().manual_seed(0)
    features = torch.randn(num, channels, generator=draw).to(dtype)
    indices = torch.randint(0, 20, (3, num), generator=draw).T  # as the parts of keys may lie in memory
    rows = torch.randint(-1, max(num, 1), (2, count + 1), generator=draw)[:, :count]  # as a top-k cuts them
    if num == 0:
        rows = rows.clamp(max=-1)
    inputs = (features, indices, rows)
    with torch.no_grad():
        found = gather_cells(*(x.to(device) for x in inputs), GRID)
    for value, expected in zip(found, gather_cells_reference(*inputs, GRID), strict=True):
        assert value.dtype == expected.dtype
        torch.testing.assert_close(value.cpu(), expected, rtol=0, atol=1e-5 if expected.shape[-1:] == (2,) else 0)
