"""Memory that operations on a CPU use again and again."""

from __future__ import annotations

import threading

import torch
from torch import Tensor


class _Scratch(threading.local):
    """Memory that every operation of a thread uses again: fresh memory costs a page fault for every 4 KiB."""

    def __init__(self) -> None:
        self.blocks: dict[tuple[str, torch.device], Tensor] = {}


_scratch = _Scratch()


def scratch(
    name: str,
    rows: int,
    columns: int,
    dtype: torch.dtype,
    device: torch.device,
) -> Tensor:  # [rows, columns]
    """Memory with arbitrary content; the same name gives the same memory again."""
    size = rows * columns * dtype.itemsize
    block = _scratch.blocks.get((name, device))
    if block is None or len(block) < size:
        with torch.inference_mode(False):  # or training could not use it after an evaluation
            block = _scratch.blocks[name, device] = torch.empty(size, dtype=torch.uint8, device=device)
    return block[:size].view(dtype).view(rows, columns)


def release_scratch() -> None:
    """Free the calling thread's reused memory; the next operation allocates it anew."""
    _scratch.blocks.clear()
