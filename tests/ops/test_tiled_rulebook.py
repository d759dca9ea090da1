"""Reused memory of the tiles, and sums over many of them in half precision."""

import threading

import pytest
import torch

from src.ops import Sites, sparse_conv, submanifold_map
from src.ops.tiled_rulebook import scratch, tiled_rulebook


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
