"""Rows of each sample, against a literal loop."""

import pytest
import torch
from torch.autograd import gradcheck

from src.ops.take_rows import take_rows


@pytest.mark.parametrize("shape", [(), (3,), (2, 4)])
@pytest.mark.parametrize("count", [0, 5])
def test_rows_are_those_of_the_own_sample(shape, count):
    value, rows = torch.randn(2, 6, *shape), torch.randint(6, (2, count))
    found = take_rows(value, rows)
    assert found.shape == (2, count, *shape)
    for sample in range(2):
        for place, row in enumerate(rows[sample]):
            assert torch.equal(found[sample, place], value[sample, row])


def test_gradients():
    value = torch.randn(2, 4, 3, dtype=torch.float64, requires_grad=True)
    assert gradcheck(lambda x: take_rows(x, torch.tensor([[3, 0, 3], [1, 1, 2]])), value)
