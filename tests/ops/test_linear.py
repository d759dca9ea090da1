"""Many rows give what torch gives, in float32 by either library and in bfloat16 as near as its digits allow."""

import pytest
import torch
import torch.nn.functional as F

from src.ops import products
from src.ops.linear import linear, linear_relu
from src.ops.products import bfloat16_products

NO_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
DEVICES = ["cpu", pytest.param("cuda", marks=[pytest.mark.gpu, NO_GPU])]


def values_and_gradients(layer, rows, bias=True, widths=(64, 48)):
    torch.manual_seed(0)
    x, weight, shift = (torch.rand(*size) for size in ((rows, widths[0]), widths, widths[1:]))
    operands = [value.requires_grad_() for value in (x, weight, shift)[: 2 + bias]]
    out = layer(*operands)
    return out, *torch.autograd.grad(out, operands, torch.rand(out.shape))


def plain(x, weight, bias=0.0):
    return x @ weight + bias


@pytest.mark.parametrize("onednn", [False, True])
@pytest.mark.parametrize(("rows", "bias"), [(0, True), (100, True), (2048, True), (4396, True), (9000, False)])
def test_float32_is_as_of_torch(rows, bias, onednn, monkeypatch):
    """Within 1e-5 of float64: no operand is negative, so no sum cancels."""
    if onednn and not torch.backends.mkldnn.is_available():
        pytest.skip("this torch has no oneDNN")
    monkeypatch.setattr(products, "prefers_onednn", lambda: onednn)
    found, expected = values_and_gradients(linear, rows, bias), values_and_gradients(plain, rows, bias)
    exact = values_and_gradients(lambda *values: plain(*(value.double() for value in values)), rows, bias)
    for value, torchs, true in zip(found, expected, exact, strict=True):
        assert value.dtype == torch.float32 and value.shape == torchs.shape
        torch.testing.assert_close(value.double(), true.double(), rtol=1e-5, atol=0)


def test_large_products_take_bfloat16_in_its_context(monkeypatch):
    monkeypatch.setattr(products, "multiplies_bfloat16", lambda: True)
    exact = values_and_gradients(linear, 4396)
    with bfloat16_products():
        near, narrow = values_and_gradients(linear, 4396), values_and_gradients(linear, 4396, widths=(64, 8))
    for a, b in zip(exact[:3], near[:3], strict=True):
        assert b.dtype == torch.float32 and 0 < (a - b).norm() < 0.005 * a.norm()
    assert torch.equal(exact[3], near[3])
    for a, b in zip(values_and_gradients(linear, 4396, widths=(64, 8)), narrow, strict=True):
        assert torch.equal(a, b)


def test_a_gradient_that_stands_for_many():
    x, weight = torch.rand(3000, 8, requires_grad=True), torch.rand(8, 4, requires_grad=True)
    linear(x, weight).sum().backward()
    torch.testing.assert_close(x.grad, weight.detach().sum(1).expand(3000, 8))
    torch.testing.assert_close(weight.grad, x.detach().sum(0)[:, None].expand(8, 4))


def test_other_types_and_autocast_are_torchs():
    for dtype in (torch.float64, torch.bfloat16):
        x, weight = torch.rand(3000, 64).to(dtype), torch.rand(64, 64).to(dtype)
        with bfloat16_products():
            assert torch.equal(linear(x, weight), x @ weight)
    with torch.autocast("cpu", torch.bfloat16):
        assert linear(torch.rand(3000, 64), torch.rand(64, 64)).dtype == torch.bfloat16


@pytest.mark.parametrize("device", DEVICES)
def test_a_linear_layer_with_its_relu(device):
    draw = torch.Generator().manual_seed(0)
    x, weight, bias = (torch.randn(*shape, generator=draw) for shape in ((2, 3, 4), (5, 4), (5,)))
    found = linear_relu(x.to(device), weight.to(device), bias.to(device))
    torch.testing.assert_close(found.cpu(), F.relu(F.linear(x, weight, bias)), rtol=1e-3, atol=1e-3)  # TF32
