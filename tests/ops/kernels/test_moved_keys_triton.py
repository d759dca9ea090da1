import pytest
import torch

from src.ops.moved_keys import moved_keys, moved_keys_reference

AXES = ((400, 7, 3, 2, 0, 9, 90), (20, 20, 1, 3, -2, 4, 8), (1, 20, 2, 1, 0, 30, 1))


@pytest.mark.parametrize("count", [0, 1, 600])
def test_keys(device, count):
    keys = torch.randint(0, 3 * 2800, (count,), generator=torch.Generator().manual_seed(count)).to(device)
    shifts = ((0, 0, 0), (1, -2, -3), (-7, 5, 4))
    found = moved_keys(keys, (2800, 900), AXES, shifts)
    assert torch.equal(found, moved_keys_reference(keys, (2800, 900), AXES, shifts))
    assert found.shape == (3, count)
