import pytest
import torch

from src.ops.distinct_keys import grouped_keys
from src.ops.segment_reduce import gather_rows, gather_rows_reference, group_sum, group_sum_reference


@pytest.mark.parametrize("mean", [False, True])
@pytest.mark.parametrize("channels", [1, 5, 32])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_sums_and_means(device, dtype, channels, mean):
    draw = torch.Generator().manual_seed(channels)
    keys = torch.randint(0, 40, (100,), generator=draw)
    groups = grouped_keys(keys.to(device), 30, 35)[2]
    values = torch.randn(100, channels, generator=draw).to(dtype)
    found = group_sum(values.to(device), groups, mean).cpu()
    wanted = group_sum_reference(values.double(), type(groups)(*(x.cpu() for x in groups)), mean)
    torch.testing.assert_close(found, wanted.to(dtype))
    assert found.dtype == dtype and (found[30:] == 0).all()


def test_nothing_in_groups(device):
    groups = grouped_keys(torch.full((4,), 9, device=device), 9, 3)[2]
    assert group_sum(torch.ones(4, 2, device=device), groups).tolist() == [[0.0, 0.0]] * 3


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float64])
@pytest.mark.parametrize(("count", "num", "channels"), [(0, 3, 4), (5, 0, 4), (7, 100, 1), (300, 50, 33)])
def test_rows_are_taken(device, count, num, channels, dtype):
    draw = torch.Generator().manual_seed(count)
    values = torch.randn(count, channels, generator=draw).to(dtype)
    rows = torch.randint(-1, max(count, 1), (num,), generator=draw).clamp(max=count - 1)
    for kind in (torch.int32, torch.int64):
        found = gather_rows(values.to(device), rows.to(device, kind))
        assert torch.equal(found.cpu(), gather_rows_reference(values, rows))
