import pytest
import torch

from src.ops.kernel_maps import strided_map, submanifold_map, temporal_map
from src.ops.sites import Sites
from src.ops.sparse_conv import sparse_conv, sparse_conv_relu
from tests.ops.maps import random_sites

# Largest error over the largest value against float64 on the same operands: float32 sums, and one rounding to the
# type of the output (which the interpreter cuts off for bfloat16: a whole unit in the last place instead of half).
TOLERANCE = {torch.float32: 2e-6, torch.float16: 6e-4, torch.bfloat16: 8e-3}


def run(kernel_map, features, weight, bias, grad, dtype):
    """Output and gradients of all operands, in the given type."""
    inputs = [x.to(dtype).requires_grad_() for x in (features, weight, bias) if x is not None]
    out = sparse_conv(inputs[0], inputs[1], kernel_map, inputs[2] if bias is not None else None)
    assert out.dtype == dtype
    return [out.detach(), *torch.autograd.grad(out, inputs, grad.to(dtype))]


def compare(kernel_map, c_in, c_out, device, dtype=torch.float32, bias=True):
    generator = torch.Generator().manual_seed(c_in)

    def normal(*size):
        return torch.randn(*size, generator=generator).to(device, dtype)

    operands = [
        normal(kernel_map.num_inputs, c_in),
        normal(c_out, c_in, kernel_map.num_offsets).permute(2, 1, 0),  # as a dense weight becomes ours: not contiguous
        normal(c_out) if bias else None,
        normal(kernel_map.num_outputs, c_out),
    ]
    found = run(kernel_map, *operands, dtype)
    for name, value, expected in zip(
        ("out", "features", "weight", "bias"), found, run(kernel_map, *operands, torch.float64), strict=False
    ):
        assert value.shape == expected.shape, name
        if expected.numel() > 0:
            error = (value.double() - expected).abs().max() / expected.abs().max().clamp(min=1e-30)
            assert error < TOLERANCE[dtype], f"{name}: {error}"
    return found


def build(mode, device):
    """Kernel maps with more rows than a block of the kernel has, in two samples."""
    if mode == "2d":
        return submanifold_map(random_sites((2, 9, 8), 100, device=device), 3)
    sites = random_sites((2, 4, 6, 7), 90, device=device)
    if mode == "3d":
        return submanifold_map(sites, 3)
    if mode == "strided":
        return strided_map(sites, 3, 2, 1)[0]
    if mode == "inverse":
        return strided_map(sites, 3, 2, 1)[0].transposed
    if mode == "dilating":
        return strided_map(sites, (1, 3, 2), 1, (0, 1, 0))[0]
    if mode == "pointwise":
        return strided_map(sites, 1, 2, 0)[0]
    return temporal_map(sites, 3, (2, 1, 1), 1)[0]


@pytest.mark.parametrize("mode", ["2d", "3d", "strided", "inverse", "dilating", "pointwise", "temporal"])
def test_values_and_gradients(device, mode):
    kernel_map = build(mode, device)
    assert kernel_map.num_outputs > (8 if mode in ("strided", "pointwise") else 64)
    compare(kernel_map, 3, 5, device)


@pytest.mark.parametrize(("c_in", "c_out"), [(1, 1), (16, 16), (40, 17), (33, 130), (150, 70)])
def test_any_number_of_channels(device, c_in, c_out):
    compare(submanifold_map(random_sites((1, 3, 3), 5, device=device), (1, 3)), c_in, c_out, device)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize("mode", ["2d", "strided"])
def test_half_precision(device, mode, dtype):
    compare(build(mode, device), 20, 18, device, dtype)


def test_without_bias(device):
    compare(build("2d", device), 4, 3, device, bias=False)


def test_many_spans_of_pairs(device, monkeypatch):
    """Spans that end within a tap, within a block of pairs, and taps without any."""
    from src.ops.kernels import sparse_conv_triton

    monkeypatch.setattr(sparse_conv_triton, "LEAST_SPAN", 7)
    monkeypatch.setattr(sparse_conv_triton, "SPANS", 10**6)
    sites, _ = Sites.from_indices(torch.stack([torch.zeros(40), torch.arange(40)], 1).long().to(device), (1, 50))
    rows = Sites.from_linear(sites.linear(), (1, 1, 50))
    kernel_map = submanifold_map(rows, 3)
    assert kernel_map.counts == (0, 0, 0, 39, 40, 39, 0, 0, 0)
    compare(kernel_map, 3, 4, device)
    first, second = (compare(kernel_map, 3, 4, device) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_more_taps_than_bits_order_the_rows(device):
    kernel_map = submanifold_map(random_sites((1, 3, 3, 3), 9, device=device), 5)
    assert kernel_map.num_offsets == 125
    compare(kernel_map, 2, 3, device)


def test_one_site(device):
    compare(submanifold_map(random_sites((1, 4, 4), 1, device=device), 3), 3, 2, device)


@pytest.mark.parametrize("mode", ["submanifold", "strided", "temporal"])
def test_no_sites(device, mode):
    sites = random_sites((2, 4, 5, 6), 0, device=device)
    if mode == "submanifold":
        kernel_map = submanifold_map(sites, 3)
    else:
        kernel_map, _ = (strided_map if mode == "strided" else temporal_map)(sites, 3, (2, 1, 1), 1)
    out, grad_features, grad_weight, grad_bias = compare(kernel_map, 3, 4, device)
    assert out.shape == (0, 4) and grad_features.shape == (0, 3)
    assert not grad_weight.any() and not grad_bias.any()


def test_samples_do_not_mix(device):
    """Two samples together give what each gives alone, also where the last row of one meets the first of the next."""
    both = random_sites((2, 4, 5), 30, device=device)
    features = torch.randn(30, 6, generator=torch.Generator().manual_seed(1)).to(device)
    weight = torch.randn(9, 6, 4, generator=torch.Generator().manual_seed(2)).to(device)
    together = sparse_conv(features, weight, submanifold_map(both, 3))
    for sample in (0, 1):
        mine = both.indices()[:, 0] == sample
        cells = both.indices()[mine] * torch.tensor([0, 1, 1], device=device)
        alone = sparse_conv(features[mine], weight, submanifold_map(Sites.from_indices(cells, (1, 4, 5))[0], 3))
        torch.testing.assert_close(together[mine], alone, rtol=1e-5, atol=1e-5)


def test_a_kernel_of_one_offset_stays_a_linear_layer(device):
    kernel_map = submanifold_map(random_sites((1, 4, 4), 6, device=device), 1)
    with pytest.raises(AssertionError, match="left its work"):
        compare(kernel_map, 3, 4, device)


def test_autocast_reaches_the_kernel(device):
    kernel_map = build("2d", device)
    features, weight = torch.randn(100, 4, device=device), torch.randn(9, 4, 3, device=device)
    with torch.autocast(device.type, dtype=torch.bfloat16):
        out = sparse_conv(features, weight, kernel_map)
    assert out.dtype == torch.bfloat16
    expected = sparse_conv(features.double(), weight.double(), kernel_map)
    assert (out.double() - expected).abs().max() < 0.02 * expected.abs().max()


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("identity", [True, False])
def test_relu_and_residual_in_the_same_launch(device, identity, dtype):
    kernel_map = build("2d", device)
    draw = torch.Generator().manual_seed(0)
    features, weight, bias, residual = (
        torch.randn(*size, generator=draw).to(device, dtype) for size in ((100, 4), (9, 4, 20), (20,), (100, 20))
    )
    added = residual if identity else None
    found = sparse_conv_relu(features, weight, kernel_map, bias, added)
    assert found.dtype == dtype
    expected = sparse_conv(features.double(), weight.double(), kernel_map, bias.double())
    expected = (expected + (residual.double() if identity else 0)).relu()
    assert (found.double() - expected).abs().max() / expected.abs().max() < TOLERANCE[dtype]
