"""Tiles change nothing, sums over many of them in half precision, and reused memory."""

import threading

import pytest
import torch

from src.ops.kernel_maps import submanifold_map
from src.ops.sites import Sites
from src.ops.sparse_conv import sparse_conv
from src.ops.sparse_conv_tiled import scratch
from src.ops.tiled_rulebook import tiled_rulebook
from tests.ops.maps import map_of, random_sites


@pytest.mark.parametrize("mode", ["submanifold", "strided", "temporal"])
def test_tiles_change_nothing(mode, monkeypatch):
    """One tile, and tiles so small that most offsets are missing in each: the same values and gradients."""
    results = []
    for least, budget in ((256, 1 << 24), (2, 64)):
        monkeypatch.setattr("src.ops.tiled_rulebook.LEAST_ROWS", least)
        monkeypatch.setattr("src.ops.tiled_rulebook.TILE_BYTES", budget)
        kernel_map = map_of(mode, random_sites((2, 5, 6, 7), 70))
        torch.manual_seed(0)
        x, w = torch.randn(70, 3).double().requires_grad_(), torch.randn(27, 3, 4).double().requires_grad_()
        out = sparse_conv(x, w, kernel_map)
        (out * torch.randn(out.shape, dtype=torch.float64)).sum().backward()
        results.append((out.detach(), x.grad, w.grad))
        assert (len(tiled_rulebook(kernel_map, False, 7, torch.float64).tiles) > 10) == (budget == 64)
    torch.testing.assert_close(results[0], results[1])


def test_half_precision_sums_over_tiles_in_full(monkeypatch):
    """Four ones from each of 400 tiles: sums in bfloat16 would stop growing at 1024."""
    monkeypatch.setattr("src.ops.tiled_rulebook.LEAST_ROWS", 4)
    monkeypatch.setattr("src.ops.tiled_rulebook.HALF_TILE_BYTES", 64)
    kernel_map = submanifold_map(Sites.from_linear(torch.arange(1600), (1, 1, 1600)), (1, 3))
    x = torch.ones(1600, 1, dtype=torch.bfloat16)
    weight = torch.ones(3, 1, 1, dtype=torch.bfloat16, requires_grad=True)
    sparse_conv(x, weight, kernel_map).sum().backward()
    assert len(tiled_rulebook(kernel_map, True, 2, torch.bfloat16).tiles) == 400
    assert weight.grad.flatten().tolist() == pytest.approx([1599, 1600, 1599], rel=0.005)


def place_of(name, rows, dtype=torch.float32):
    block = scratch(name, rows, 3, dtype, torch.device("cpu"))
    assert block.shape == (rows, 3) and block.dtype == dtype
    return block, block.data_ptr()


def test_the_same_name_gives_the_same_memory_until_more_is_needed():
    first, place = place_of("a", 50)
    assert place_of("a", 20, torch.float64)[1] == place and place_of("b", 20)[1] != place
    larger, elsewhere = place_of("a", 500)
    assert elsewhere != place and place_of("a", 50)[1] == elsewhere
    assert first.shape == (50, 3) and larger.shape == (500, 3)  # both alive, so that addresses tell them apart


def test_threads_do_not_share_memory():
    """Two detectors in two threads would write into each other's tiles: torch lets go of the interpreter meanwhile."""
    mine, place = place_of("shared", 50)
    found = []
    thread = threading.Thread(target=lambda: found.append(place_of("shared", 50)))
    thread.start()
    thread.join()
    assert mine.shape == found[0][0].shape and found[0][1] != place


def test_training_after_inference_in_the_same_process():
    """Memory reused between calls must not be bound to inference mode."""
    kernel_map = submanifold_map(random_sites((1, 9, 9), 30), 3)
    x, w = torch.randn(30, 3), torch.randn(9, 3, 700, requires_grad=True)
    with torch.inference_mode():
        expected = sparse_conv(x, w, kernel_map)
    out = sparse_conv(x, w, kernel_map)
    out.sum().backward()
    assert torch.equal(out, expected) and w.grad.isfinite().all()
