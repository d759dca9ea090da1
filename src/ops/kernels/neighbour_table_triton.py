"""A neighbour table by one Triton launch: a binary search for every tap and cell."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from src.ops.backend import runs_kernels
from src.ops.neighbour_table import ORDERING_TAPS, neighbour_table_reference

CELLS = 256
"""Cells a program looks around, one lane each."""


def neighbour_table_triton(
    keys: Tensor,  # [n] int64, sorted, unique
    corners: Tensor,  # [m] int64
    taps: Tensor,  # [K] int64
) -> tuple[Tensor, Tensor]:  # [K, m] int32, [m] int64
    """The reference's table and bits."""
    if not runs_kernels(keys):
        return neighbour_table_reference(keys, corners, taps)
    table = corners.new_empty((len(taps), len(corners)), dtype=torch.int32)
    bits = torch.empty_like(corners)
    if len(corners) > 0:
        with torch.cuda.device_of(keys):
            _search[(triton.cdiv(len(corners), CELLS),)](
                *(keys, corners, taps, table, bits),
                *(len(keys), len(corners), len(taps), len(keys).bit_length()),
                BITS=ORDERING_TAPS,
                BLOCK=CELLS,
                num_warps=4,
            )
    return table, bits


@triton.jit(do_not_specialize=["num", "cells", "all_taps", "steps"])
def _search(  # noqa: ANN202
    keys, corners, taps, table, bits, num, cells, all_taps, steps,  # noqa: ANN001
    BITS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """All taps of a block of cells; after `steps` halvings `low` is the first row whose key is not below the wanted."""
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = place < cells
    corner = tl.load(corners + place, mask=live, other=0)
    seen = tl.zeros((BLOCK,), tl.int64)
    for tap in range(0, all_taps):
        wanted = corner + tl.load(taps + tap)
        low = tl.zeros((BLOCK,), tl.int32)
        high = low + num
        for _ in range(0, steps):
            open_ = low < high
            middle = (low + high) // 2
            below = open_ & (tl.load(keys + middle, mask=open_, other=0) < wanted)
            low = tl.where(below, middle + 1, low)
            high = tl.where(open_ & (below == 0), middle, high)
        inside = low < num
        found = inside & (tl.load(keys + low, mask=inside, other=0) == wanted)
        tl.store(table + tap * cells + place, tl.where(found, low, -1), mask=live)
        if tap < BITS:
            seen += found.to(tl.int64) << tap
    tl.store(bits + place, seen, mask=live)
