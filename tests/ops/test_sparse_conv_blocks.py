"""Blocks of offsets change nothing, and products in bfloat16 are as near as its digits allow."""

import pytest
import torch

from src.ops.kernel_maps import submanifold_map
from src.ops.products import bfloat16_products, product_type
from src.ops.sites import Sites
from src.ops.sparse_conv import plain_sparse_conv
from src.ops.sparse_conv_blocks import blocked_sparse_conv, blocks
from tests.ops.maps import map_of, random_sites, stack_of, values_and_gradients


def blocked(x, w, kernel_map, bias):
    return blocked_sparse_conv(x, w, kernel_map, bias, product_type(x, w.shape[2]))


@pytest.mark.parametrize("fill", [0.0, 0.3, 2.0])
@pytest.mark.parametrize("mode", ["submanifold", "strided", "temporal", "inverse"])
def test_blocks_and_their_size_change_nothing(mode, fill, monkeypatch):
    """One block of all 27 offsets, one for each plane or row of the kernel, several products of a block."""
    monkeypatch.setattr("src.ops.sparse_conv_blocks.LEAST_FILL", fill)
    monkeypatch.setattr("src.ops.sparse_conv_blocks.SMALL", 0)
    monkeypatch.setattr("src.ops.sparse_conv_blocks.GATHERED_BYTES", 1)
    kernel_map = map_of(mode, random_sites((2, 9, 16, 17), 1200))
    found = values_and_gradients(blocked, kernel_map)
    for backward in (False, True):
        sizes = {part.offsets.stop - part.offsets.start for part in blocks(kernel_map, backward)}
        assert sizes == {27} if fill == 0 else sizes == {3} if fill == 2 else len(sizes) == 1
    torch.testing.assert_close(found, values_and_gradients(plain_sparse_conv, kernel_map))


@pytest.mark.parametrize("rows", [256, 512])
def test_as_many_rows_as_fill_their_steps(rows):
    """All rows of a block that has every one of them: the features' padding is then a step longer than the block's."""
    kernel_map = submanifold_map(Sites.from_linear(torch.arange(rows), (1, 1, rows)), (1, 3))
    found = values_and_gradients(blocked, kernel_map)
    assert any(part.rows is None and len(part.table) == rows for part in blocks(kernel_map, backward=True))
    torch.testing.assert_close(found, values_and_gradients(plain_sparse_conv, kernel_map))


def test_blocks_hold_every_pair_once():
    sites = random_sites((2, 40, 50), 900)
    parts = [torch.arange(0, 900, 2), torch.arange(0, 900, 3)]
    strided = map_of("strided", random_sites((2, 9, 16, 17), 1200))
    for kernel_map in (submanifold_map(sites, 5), stack_of(sites, 3, parts), strided):
        for backward in (False, True):
            ends = (kernel_map.outputs, kernel_map.inputs) if backward else (kernel_map.inputs, kernel_map.outputs)
            offsets = torch.repeat_interleave(torch.tensor(kernel_map.counts))
            expected = zip(*(x.tolist() for x in (offsets, *ends)), strict=True)
            found = []
            for part in blocks(kernel_map, backward):
                assert len(part.table) % 256 == 0
                nothing = kernel_map.num_outputs if backward else kernel_map.num_inputs
                at, offset = (part.table < nothing).nonzero().unbind(1)
                rows = at if part.rows is None else part.rows[at]
                columns = (offset + part.offsets.start, part.table[at, offset], rows)
                found += zip(*(x.tolist() for x in columns), strict=True)
            assert sorted(found) == sorted(expected)
        assert blocks(kernel_map) is blocks(kernel_map)


def test_products_in_bfloat16_are_as_near_as_its_digits_allow():
    """Values and gradients of a convolution whose products are large; sums are in float32."""
    kernel_map = submanifold_map(random_sites((1, 60, 60), 2000), 3)
    exact = values_and_gradients(blocked, kernel_map, 64, torch.float32)
    with bfloat16_products():
        near = values_and_gradients(blocked, kernel_map, 64, torch.float32)
    for a, b in zip(exact, near, strict=True):
        assert b.dtype == torch.float32 and (a - b).norm() < 0.005 * a.norm()


def test_half_precision_sums_over_products_in_full(monkeypatch):
    """Ones of 200 products: sums in bfloat16 would stop growing at 256 of them."""
    monkeypatch.setattr("src.ops.sparse_conv_blocks.GATHERED_BYTES", 1)
    kernel_map = submanifold_map(Sites.from_linear(torch.arange(51200), (1, 1, 51200)), (1, 3))
    x = torch.ones(51200, 1, dtype=torch.bfloat16)
    weight = torch.ones(3, 1, 1, dtype=torch.bfloat16, requires_grad=True)
    blocked(x, weight, kernel_map, None).sum().backward()
    assert weight.grad.flatten().tolist() == pytest.approx([51199, 51200, 51199], rel=0.005)
