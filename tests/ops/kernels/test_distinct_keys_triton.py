import pytest
import torch

from src.ops.distinct_keys import distinct_keys, distinct_keys_reference, grouped_keys
from src.ops.kernels.distinct_keys_triton import KEYS, MOST_ALONE

NONE = torch.iinfo(torch.int64).max


@pytest.mark.parametrize("end", [900, NONE])
@pytest.mark.parametrize(
    ("count", "size"),
    [(1, 1), (7, 7), (700, 700), (MOST_ALONE - 1, 1000), (MOST_ALONE, MOST_ALONE), (5 * KEYS - 1, 1000), (9000, 200)],
)
def test_keys_and_groups(device, count, size, end):
    keys = torch.randint(-3, 1000, (count,), generator=torch.Generator().manual_seed(count)) * 2
    keys[-1] = NONE
    found = distinct_keys(keys.to(device), end, size).cpu()
    wanted = keys[keys < end].unique()[:size].tolist()
    assert found.tolist() == wanted + [end] * (size - len(wanted))
    again, rows, groups = (x if isinstance(x, tuple) else x.cpu() for x in grouped_keys(keys.to(device), end, size))
    assert torch.equal(again, found) and rows.min() >= 0 and rows.max() < size
    order, starts = groups[0].cpu(), groups[1].cpu()
    assert torch.equal(order, keys.sort(stable=True).indices)
    for row, key in enumerate(wanted):
        members = (keys == key).nonzero().squeeze(1)
        if row < size - 1 or len(keys[keys < end].unique()) <= size:
            assert torch.equal(order[starts[row] : starts[row + 1]], members)
        assert (rows[members] == row).all()
    assert (starts[len(wanted) :] == (keys < end).sum()).all()
    assert (again[rows[keys >= end]] >= end).all() or len(wanted) == size


def test_what_is_negative_has_a_place(device):
    keys = torch.tensor([-1, -1, 4, 9], device=device)
    assert distinct_keys(keys, 9, 4).tolist() == distinct_keys_reference(keys.cpu(), 9, 4).tolist() == [-1, 4, 9, 9]
