"""Independent branches of a network side by side on a GPU."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache

import torch


@contextmanager
def on_side_stream(device: torch.device) -> Iterator[Callable[[], None]]:
    """On a GPU the context's work goes on beside what follows it, in a CUDA graph as a branch of its own.

    Yields what to call before anything reads its results. On a CPU one comes after the other, and in training, whose
    memory two streams would split. No constant that is kept (`geometry/constants.py`) may be made inside.
    """
    if device.type != "cuda" or torch.is_grad_enabled():
        yield lambda: None
        return
    stream = torch.cuda.current_stream(device)
    branch = _branch_of(device, stream.cuda_stream)
    branch.wait_stream(stream)
    with torch.cuda.stream(branch):
        yield lambda: stream.wait_stream(branch)


@cache
def _branch_of(device: torch.device, stream: int) -> torch.cuda.Stream:
    """The side stream of one stream: it waits for that one alone before it takes memory of earlier frames again."""
    return torch.cuda.Stream(device)
