"""Last layers of heads under autocast."""

import pytest
import torch

from src.models.layers.full_precision import FullPrecisionConv2d, FullPrecisionLinear


@pytest.mark.parametrize(
    ("layer", "shape"), [(FullPrecisionLinear(6, 2), (5, 6)), (FullPrecisionConv2d(6, 2, 1), (2, 6, 3, 4))]
)
def test_a_half_input_gives_what_float32_arithmetic_gives(layer, shape):
    x = torch.randn(*shape, generator=torch.Generator().manual_seed(0)).bfloat16().requires_grad_()
    expected = layer(x.detach().float())
    with torch.autocast("cpu", torch.bfloat16):
        found = layer(x)
    assert torch.equal(found, expected)
    found.sum().backward()
    assert x.grad.dtype == torch.bfloat16 and layer.weight.grad.dtype == torch.float32
    assert layer.double()(x.detach().double()).dtype == torch.float64
