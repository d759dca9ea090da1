"""Memory that operations on a CPU use again and again."""

import threading

import torch

from src.ops.scratch import scratch


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
    """Two detectors in two threads would write into each other's rows: torch lets go of the interpreter meanwhile."""
    mine, place = place_of("shared", 50)
    found = []
    thread = threading.Thread(target=lambda: found.append(place_of("shared", 50)))
    thread.start()
    thread.join()
    assert mine.shape == found[0][0].shape and found[0][1] != place
