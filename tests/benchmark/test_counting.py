"""Counted arithmetic and traffic against counts by hand, inside hand-written gradients too."""

import pytest
import torch
import torch.nn.functional as F

from src.benchmark.counting import counted_work, distinct_bytes
from src.ops import backend, products
from src.ops.kernel_maps import submanifold_map
from src.ops.sites import Sites
from src.ops.sparse_conv import sparse_conv


def test_a_matrix_product_and_its_gradients():
    a, b = torch.randn(4, 3, requires_grad=True), torch.randn(3, 5, requires_grad=True)
    with counted_work() as work:
        product = a @ b
    assert work.flops == 2 * 4 * 3 * 5
    assert work.bytes == 4 * (4 * 3 + 3 * 5 + 4 * 5)  # float32: both inputs and the output
    with counted_work() as work:
        product.backward(torch.ones(4, 5))
    assert work.flops == 2 * (4 * 5 * 3 + 3 * 4 * 5)  # of a and of b


def test_views_and_fresh_memory_are_free():
    x = torch.randn(6, 4)
    with counted_work() as work:
        y = x.t().reshape(2, 2, 6)[0]
        torch.empty(1000)
    assert (work.flops, work.bytes) == (0, 0)
    with counted_work() as work:
        y.contiguous().add_(1.0)  # a slice of a transposed matrix must be copied; the addition reads and writes
    assert work.bytes == 4 * 12 * (2 if not y.is_contiguous() else 0) + 4 * 12 * 2


@pytest.mark.parametrize("bias", [False, True])
def test_convolution(bias):
    conv = torch.nn.Conv2d(3, 8, 3, padding=1, bias=bias)
    with counted_work() as work:
        conv(torch.randn(2, 3, 10, 12))
    assert work.flops == 2 * (2 * 10 * 12) * 8 * 3 * 9


def test_inference_mode_hides_nothing():
    """Layers come whole there, not as the products that they are made of."""
    linear, conv = torch.nn.Linear(4, 5), torch.nn.Conv2d(4, 5, 3)
    with torch.inference_mode(), counted_work() as work:
        linear(torch.randn(3, 4))
        conv(torch.randn(1, 4, 8, 8))
        torch.matmul(torch.randn(3, 4), torch.randn(4, 3))
    assert work.flops == 2 * 3 * 4 * 5 + 2 * 36 * 5 * 4 * 9 + 2 * 3 * 4 * 3


def test_grouped_products():
    rows, matrices = torch.randn(10, 8), torch.randn(3, 8, 16)
    ends = torch.tensor([3, 5, 10], dtype=torch.int32)
    with counted_work() as work:
        out = F.grouped_mm(rows, matrices, offs=ends)
    assert work.flops == 2 * 10 * 8 * 16  # every row meets one matrix
    with counted_work() as work:
        F.grouped_mm(rows.t(), out, offs=ends)
    assert work.flops == 2 * 10 * 8 * 16  # three products whose inner axes are 3, 2 and 5 long


def test_products_into_given_memory_count_once():
    a, b, out = torch.randn(4, 3), torch.randn(3, 5), torch.empty(4, 5)
    with counted_work() as work:
        torch.mm(a, b, out=out)
        out.addmm_(a, b)
    assert work.flops == 2 * (2 * 4 * 3 * 5)
    assert work.bytes == 4 * (12 + 15 + 20) + 4 * (20 + 12 + 15 + 20)


@pytest.mark.parametrize("onednn", [False, True])
def test_a_linear_layer_by_either_library(onednn, monkeypatch):
    if onednn and not torch.backends.mkldnn.is_available():
        pytest.skip("this torch has no oneDNN")
    monkeypatch.setattr(products, "prefers_onednn", lambda: onednn)
    with counted_work() as work:
        products.matmul(torch.randn(256, 3), torch.randn(3, 5))
    assert work.flops == 2 * 256 * 3 * 5


def test_attention_forward_and_backward():
    q, k, v = (torch.randn(2, 4, length, 8, requires_grad=True) for length in (6, 9, 9))
    with counted_work() as work:
        out = F.scaled_dot_product_attention(q, k, v)
    assert work.flops == 2 * (2 * 4) * 6 * 9 * (8 + 8)
    with counted_work() as work:
        out.sum().backward()
    assert work.flops == 5 * 2 * (2 * 4) * 6 * 9 * 8  # scores again, and gradients of v, scores, q and k


@pytest.mark.parametrize("channels", [(8, 16), (4, 4)])
def test_a_sparse_convolution_is_two_flops_per_pair_and_weight(channels):
    """Its gradients are computed by a Function of ours, which modules' hooks would not see into."""
    cells = torch.tensor([[0, 0, 0], [0, 0, 1], [0, 1, 1], [0, 3, 3], [0, 3, 4], [0, 6, 2]])
    sites, _ = Sites.from_indices(cells, (1, 7, 8))
    pairs = 6 + 2 * 4  # every cell meets itself, and both ways: (0,0)-(0,1), (0,0)-(1,1), (0,1)-(1,1), (3,3)-(3,4)
    kernel_map = submanifold_map(sites, 3)
    assert len(kernel_map.inputs) == pairs
    features = torch.randn(6, channels[0], requires_grad=True)
    weight = torch.randn(9, *channels, requires_grad=True)
    with counted_work() as work:
        out = sparse_conv(features, weight, kernel_map)
    forward = 2 * pairs * channels[0] * channels[1]
    assert work.flops == forward
    with counted_work() as work:
        out.backward(torch.ones_like(out))
    assert work.flops == 2 * forward


def test_the_backend_is_as_before_even_after_an_error():
    before = backend.chosen()
    with pytest.raises(ZeroDivisionError), counted_work():
        assert backend.chosen() == backend.COUNTED
        1 / 0  # noqa: B018
    assert backend.chosen() == before


def test_shared_memory_counts_once():
    x = torch.randn(10)
    assert distinct_bytes([x, x, x.view(2, 5), torch.randn(3)]) == 4 * 13
