"""Which type a product takes, and that float32 stays float32 whichever library multiplies."""

import pytest
import torch

from src.ops import products
from src.ops.products import bfloat16_products, matmul, matmul_tn, product_type, row_steps


@pytest.fixture(params=[False, True], ids=["torch", "oneDNN"])
def library(request, monkeypatch):
    if request.param and not torch.backends.mkldnn.is_available():
        pytest.skip("this torch has no oneDNN")
    monkeypatch.setattr(products, "prefers_onednn", lambda: request.param)


@pytest.mark.parametrize("shape", [(256, 64, 64), (300, 7, 5), (64, 512, 96), (1, 1, 1)])
def test_float32_has_all_its_digits(shape, library):
    torch.manual_seed(0)
    n, k, m = shape
    a, b = torch.rand(n, k), torch.rand(k, m)  # no cancellation: errors are relative to the result
    for left, right in ((a, b), (torch.rand(k, n).t(), b), (a, torch.rand(m, k).t())):
        expected = left.double() @ right.double()
        torch.testing.assert_close(matmul(left, right).double(), expected, rtol=1e-5, atol=0)


@pytest.mark.skipif(not torch.backends.mkldnn.is_available(), reason="this torch has no oneDNN")
def test_onednn_is_given_no_part_of_a_wider_matrix(monkeypatch):
    """It multiplies one as well, but by its slow reference code."""
    given, found = torch.ops.mkldnn._linear_pointwise, []
    monkeypatch.setattr(products, "prefers_onednn", lambda: True)
    monkeypatch.setattr(
        torch.ops.mkldnn, "_linear_pointwise", lambda a, b, *rest: found.append(b.stride()) or given(a, b, *rest)
    )
    a, wide = torch.rand(64, 16), torch.rand(16, 48)
    for part in (wide[:, 16:32], wide.t()[16:32].t()):
        torch.testing.assert_close(matmul(a, part), a @ part)
    assert all(sorted(stride) == [1, 16] for stride in found) and len(found) == 2


def test_other_types_are_multiplied_as_they_are(library):
    a, b = torch.randn(256, 64), torch.randn(64, 64)
    for dtype in (torch.float64, torch.bfloat16):
        assert torch.equal(matmul(a.to(dtype), b.to(dtype)), a.to(dtype) @ b.to(dtype))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float64])
def test_the_positive_part_of_a_product(dtype, library):
    a, b, bias = (torch.randn(*shape).to(dtype) for shape in ((300, 64), (64, 96), (96,)))
    torch.testing.assert_close(matmul(a, b, bias, relu=True), torch.addmm(bias, a, b).clamp(min=0))


@pytest.mark.parametrize("widths", [(12, 64), (64, 12)])
def test_products_over_rows_whichever_operand_is_the_wider(widths, library):
    a, b = torch.rand(300, widths[0]), torch.rand(300, widths[1])
    torch.testing.assert_close(matmul_tn(a, b).double(), a.double().t() @ b.double(), rtol=1e-5, atol=0)


def test_autocast_does_not_round_what_its_caller_keeps_in_float32(library):
    a, b, bias = torch.rand(256, 64), torch.rand(64, 64), torch.rand(64)
    with torch.autocast("cpu", torch.bfloat16):
        plain, with_bias = matmul(a, b), matmul(a, b, bias)
    torch.testing.assert_close(plain.double(), a.double() @ b.double(), rtol=1e-5, atol=0)
    torch.testing.assert_close(with_bias.double(), a.double() @ b.double() + bias.double(), rtol=1e-5, atol=0)


def test_large_products_of_float32_take_bfloat16_in_its_context(monkeypatch):
    monkeypatch.setattr(products, "multiplies_bfloat16", lambda: True)
    large, short, narrow = torch.zeros(4096, 64), torch.zeros(128, 64), torch.zeros(4096, 16)
    assert product_type(large, 64) == torch.float32
    with bfloat16_products():
        assert [product_type(x, 64) for x in (large, short, narrow)] == [torch.bfloat16, torch.float32, torch.float32]
        assert product_type(large, 32) == torch.bfloat16 and product_type(large, 8) == torch.float32
        assert product_type(large.double(), 64) == torch.float64
        with bfloat16_products(False):
            assert product_type(large, 64) == torch.float32
    assert product_type(large, 64) == torch.float32
    monkeypatch.setattr(products, "multiplies_bfloat16", lambda: False)
    with bfloat16_products():
        assert product_type(large, 64) == torch.float32


def test_rows_are_padded_to_steps():
    assert [row_steps(rows) for rows in (0, 1, 256, 257)] == [0, 256, 256, 512]
