"""Convolutions of whole maps against torch's own: values and all gradients."""

import subprocess
import sys

import pytest
import torch
import torch.nn.functional as F
from torch.autograd import gradcheck

from src.ops import map_conv, products
from src.ops.map_conv import conv2d, map_conv2d, weight_gradient
from src.ops.products import bfloat16_products
from tests.running import ROOT


@pytest.fixture(params=[False, True], ids=["oneDNN", "products"])
def gradients(request, monkeypatch):
    monkeypatch.setattr(map_conv, "slow_weight_gradients", lambda: request.param)


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize("size", [(8, 12), (70, 66), (5, 7)])
@pytest.mark.parametrize(("kernel_size", "stride"), [(1, 1), (1, 2), (3, 1), (3, 2), (5, 2), (3, 4)])
def test_agrees_with_torch(kernel_size, stride, size, bias, gradients):
    torch.manual_seed(0)
    x = torch.randn(2, 16, *size).contiguous(memory_format=torch.channels_last).requires_grad_()
    weight = torch.randn(24, 16, kernel_size, kernel_size, requires_grad=True)
    offset = torch.randn(24, requires_grad=True) if bias else None
    leaves = [x, weight, *([offset] if bias else [])]
    out = map_conv2d(x, weight, offset, stride)
    exact = [leaf.detach().double().requires_grad_() for leaf in leaves]
    expected = F.conv2d(*exact, stride=stride, padding=kernel_size // 2)
    pull = torch.randn_like(out)
    results = [(out, *torch.autograd.grad(out, leaves, pull))]
    results.append((expected, *torch.autograd.grad(expected, exact, pull.double())))
    for own, other in zip(*results, strict=True):
        scale = other.abs().max().item()
        torch.testing.assert_close(own.double(), other, rtol=0, atol=1e-5 * scale)


def test_gradients_of_the_weights_are_exact():
    """In float64, where rounding hides nothing; more cells than one product takes."""
    torch.manual_seed(0)
    for kernel_size, stride, size in ((3, 1, (70, 66)), (3, 2, (9, 10)), (1, 2, (8, 8)), (5, 1, (6, 7))):
        x = torch.randn(2, 3, *size, dtype=torch.float64)
        weight = torch.randn(4, 3, kernel_size, kernel_size, dtype=torch.float64, requires_grad=True)
        out = F.conv2d(x, weight, None, stride, kernel_size // 2)
        pull = torch.randn_like(out)
        (expected,) = torch.autograd.grad(out, weight, pull)
        torch.testing.assert_close(weight_gradient(x, pull, kernel_size, stride), expected)


def test_gradcheck(gradients):
    """The function itself; only its entry asks for float32."""
    leaves = [torch.randn(*shape, dtype=torch.float64, requires_grad=True) for shape in ((2, 3, 4, 6), (2, 3, 3, 3))]
    assert gradcheck(lambda x, weight: map_conv._Conv.apply(x, weight, None, 2, 1, torch.float64), leaves)


def test_a_map_that_needs_no_gradient_gets_none(gradients):
    x, weight = torch.randn(1, 16, 8, 8), torch.randn(16, 16, 3, 3, requires_grad=True)
    (grad,) = torch.autograd.grad(map_conv2d(x, weight).sum(), weight)
    assert grad.shape == weight.shape
    assert not map_conv2d(x, weight.detach()).requires_grad


def test_autocast_convolves_in_its_type(gradients):
    with torch.autocast("cpu", torch.bfloat16):
        out = map_conv2d(torch.randn(1, 16, 8, 8), torch.randn(16, 16, 1, 1))
    assert out.dtype == torch.bfloat16


@pytest.mark.skipif(not products.fuses_bfloat16(), reason="here torch sums bfloat16 convolutions in bfloat16")
@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize(("kernel_size", "stride", "padding"), [(1, 1, 0), (3, 1, 1), (3, 2, 1), (7, 2, 3), (2, 2, 0)])
def test_large_convolutions_round_their_operands_in_the_context(kernel_size, stride, padding, bias, monkeypatch):
    """Values and gradients are those of the rounded operands, each rounded once; without the context nothing is."""
    monkeypatch.setattr(products, "multiplies_bfloat16", lambda: True)
    torch.manual_seed(0)
    leaves = [torch.randn(2, 16, 48, 50), torch.randn(24, 16, kernel_size, kernel_size)]
    leaves += [torch.randn(24)] if bias else []
    leaves = [leaf.to(memory_format=torch.channels_last) if leaf.dim() == 4 else leaf for leaf in leaves]
    exact, rounded = ([leaf.clone().requires_grad_() for leaf in leaves] for _ in range(2))
    rest = (None,) if not bias else ()
    with bfloat16_products():
        out = conv2d(*rounded, *rest, stride, padding)
    pull = torch.randn_like(out)
    results = [(out, *torch.autograd.grad(out, rounded, pull))]
    doubles = [leaf.detach().bfloat16().double().requires_grad_() for leaf in exact]
    expected = F.conv2d(*doubles, *rest, stride, padding)
    coarse = torch.autograd.grad(expected, doubles[:2], pull.bfloat16().double())
    results.append((expected, *coarse, *([pull.sum((0, 2, 3)).double()] if bias else [])))
    for own, other in zip(*results, strict=True):
        assert own.dtype == torch.float32
        torch.testing.assert_close(own.double(), other, rtol=2**-8, atol=1e-3 * other.abs().max().item())
    assert torch.equal(conv2d(*exact, *rest, stride, padding), F.conv2d(*exact, *rest, stride, padding))
    assert not torch.equal(out, F.conv2d(*exact, *rest, stride, padding))


def test_small_convolutions_stay_in_float32(monkeypatch):
    monkeypatch.setattr(products, "multiplies_bfloat16", lambda: True)
    with bfloat16_products():
        for channels, size in ((3, 64), (16, 8)):
            x, weight = torch.randn(1, channels, size, size), torch.randn(16, channels, 3, 3)
            assert torch.equal(conv2d(x, weight, None, 1, 1), F.conv2d(x, weight, None, 1, 1))


NARROW = """
import torch
from src.models.backbones.resnet import BasicBlock, ResNet
net = ResNet(BasicBlock, {widths}, [1, 1, 1, 1]).to(memory_format=torch.channels_last)
images = torch.rand(4, 3, 128, 320).contiguous(memory_format=torch.channels_last)
sum(level.square().sum() for level in net(images)).backward()
"""


@pytest.mark.parametrize("widths", [[8, 16, 32, 64], [12, 16, 16, 16]])
def test_narrow_stages_have_a_backward_pass(widths):
    """In a process of its own: oneDNN would end it."""
    done = subprocess.run([sys.executable, "-c", NARROW.format(widths=widths)], cwd=ROOT, capture_output=True)
    assert done.returncode == 0, done.stderr


def test_a_narrow_strided_layer_is_the_layer():
    draw = torch.Generator().manual_seed(0)
    x, weight = torch.randn(2, 8, 9, 7, generator=draw), torch.randn(5, 8, 1, 1, generator=draw)
    torch.testing.assert_close(conv2d(x, weight, stride=2), F.conv2d(x, weight, stride=2))
