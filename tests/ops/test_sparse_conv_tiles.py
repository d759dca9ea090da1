"""Tiles change nothing and hold every pair once; which form a CPU takes."""

import pytest
import torch

from src.ops import sparse_conv_cpu
from src.ops.kernel_maps import submanifold_map
from src.ops.products import bfloat16_products, multiplies_bfloat16
from src.ops.sparse_conv import plain_sparse_conv, sparse_conv
from src.ops.sparse_conv_tiles import tiled_rulebook, tiled_sparse_conv
from tests.ops.maps import map_of, random_sites, stack_of, values_and_gradients


def kernel_map_of(mode):
    if mode == "stacked":
        return stack_of(random_sites((2, 40, 50), 900), 3, [torch.arange(0, 900, 2), torch.arange(0, 900, 3)])
    return map_of(mode, random_sites((2, 9, 16, 17), 1200))


def make_small(monkeypatch):
    monkeypatch.setattr("src.ops.sparse_conv_tiles.LEAST_ROWS", 2)
    monkeypatch.setattr("src.ops.sparse_conv_tiles.TILE_BYTES", 64)


@pytest.mark.parametrize("small", [False, True])
@pytest.mark.parametrize("mode", ["submanifold", "strided", "temporal", "inverse", "stacked"])
def test_tiles_and_their_size_change_nothing(mode, small, monkeypatch):
    """One tile, and tiles so small that most offsets are missing in each."""
    if small:
        make_small(monkeypatch)
    kernel_map = kernel_map_of(mode)
    found = values_and_gradients(tiled_sparse_conv, kernel_map)
    assert (len(tiled_rulebook(kernel_map, False, 56).tiles) > 10) == small
    torch.testing.assert_close(found, values_and_gradients(plain_sparse_conv, kernel_map))


@pytest.mark.parametrize("backward", [False, True])
@pytest.mark.parametrize("mode", ["submanifold", "strided", "temporal", "inverse", "stacked"])
def test_tiles_hold_every_pair_once_but_those_of_the_centre(mode, backward, monkeypatch):
    make_small(monkeypatch)
    kernel_map = kernel_map_of(mode)
    rulebook = tiled_rulebook(kernel_map, backward, 56)
    turned = backward and not kernel_map.mirrored
    found = []
    for tile in rulebook.tiles:
        assert len(tile.gathered) <= rulebook.most_pairs
        by_row = tile.summed[tile.order.long()]
        for row, (first, last) in enumerate(zip(tile.starts[:-1].tolist(), tile.starts[1:].tolist(), strict=True)):
            assert (by_row[first:last] == tile.first + row).all()
        for offset, first, last in tile.spans:
            pairs = (tile.gathered[first:last].tolist(), tile.summed[first:last].tolist())
            found += [(offset, *pair) for pair in zip(*(reversed(pairs) if turned else pairs), strict=True)]
    offsets = torch.repeat_interleave(torch.tensor(kernel_map.counts)).tolist()
    every = zip(offsets, kernel_map.inputs.tolist(), kernel_map.outputs.tolist(), strict=True)
    centre = 13 if mode == "submanifold" else None
    assert len(rulebook.tiles) > 10
    assert sorted(found) == sorted(pair for pair in every if pair[0] != centre)
    assert tiled_rulebook(kernel_map, backward, 56) is rulebook


@pytest.mark.parametrize(
    ("onednn", "dtype", "width", "half", "expected"),
    [
        (False, torch.float32, 128, False, "tiles"),
        (False, torch.float64, 8, False, "tiles"),
        (False, torch.bfloat16, 8, False, "blocks"),
        (True, torch.float32, 8, False, "blocks"),
        (False, torch.float32, 32, True, "tiles"),  # bfloat16 multiplies faster, but more zeros: 0.6 of pairs exist
        (False, torch.float32, 64, True, "blocks"),
        (True, torch.float32, 32, True, "blocks"),
    ],
)
def test_products_of_every_shape_where_the_library_takes_them(onednn, dtype, width, half, expected, monkeypatch):
    if half and not multiplies_bfloat16():
        pytest.skip("this processor has no products of bfloat16")
    taken = []
    monkeypatch.setattr(sparse_conv_cpu, "prefers_onednn", lambda: onednn)
    for form in ("tiles", "blocks"):
        name = {"tiles": "tiled_sparse_conv", "blocks": "blocked_sparse_conv"}[form]
        own = getattr(sparse_conv_cpu, name)
        monkeypatch.setattr(sparse_conv_cpu, name, lambda *x, form=form, own=own: taken.append(form) or own(*x))
    kernel_map = submanifold_map(random_sites((1, 60, 60), 2000), 3)
    x, w = torch.randn(2000, width, dtype=dtype), torch.randn(9, width, 2 * width, dtype=dtype)
    with bfloat16_products(half):
        sparse_conv(x, w, kernel_map)
    assert taken == [expected]


@pytest.mark.parametrize("onednn", [False, True])
def test_training_after_inference_in_the_same_process(onednn, monkeypatch):
    """Memory reused between calls must not be bound to inference mode."""
    monkeypatch.setattr(sparse_conv_cpu, "prefers_onednn", lambda: onednn)
    kernel_map = submanifold_map(random_sites((1, 9, 9), 30), 3)
    x, w = torch.randn(30, 3), torch.randn(9, 3, 700, requires_grad=True)
    with torch.inference_mode():
        expected = sparse_conv(x, w, kernel_map)
    out = sparse_conv(x, w, kernel_map)
    out.sum().backward()
    assert torch.equal(out, expected) and w.grad.isfinite().all()
