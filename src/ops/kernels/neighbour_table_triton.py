"""Neighbour tables by a Triton launch each.

A binary search for every tap and cell, whose key may be moved before; reading a table backwards; taking the rows of
two parts.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from src.geometry.constants import constant
from src.ops.backend import runs_kernels
from src.ops.kernels.moved_keys_triton import moved_key
from src.ops.kernels.sorted_search_triton import lower_bound
from src.ops.moved_keys import NONE, Axis
from src.ops.neighbour_table import (
    ORDERING_TAPS,
    moved_table_reference,
    neighbour_table_reference,
    stacked_table_reference,
    transposed_table_reference,
)

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
    return _searched(keys, corners, taps, keys, keys, (1, 1), 0)


def moved_table_triton(
    keys: Tensor,  # [n] int64, sorted, unique
    cells: Tensor,  # [m] int64
    samples: tuple[int, int],
    axes: tuple[Axis, ...],
    shift: tuple[int, ...],
    taps: Tensor,  # [K] int64
) -> tuple[Tensor, Tensor]:  # [K, m] int32, [m] int64
    """The reference's table and bits."""
    if not runs_kernels(keys):
        return moved_table_reference(keys, cells, samples, axes, shift, taps)
    plan, shifts = (constant(rows, torch.int64, keys.device) for rows in (axes, shift))
    return _searched(keys, cells, taps, plan, shifts, samples, len(axes))


def _searched(
    keys: Tensor,  # [n] int64
    cells: Tensor,  # [m] int64, the corners themselves where there are no axes
    taps: Tensor,  # [K] int64
    plan: Tensor,  # [axes, 7] int64
    shifts: Tensor,  # [axes] int64
    samples: tuple[int, int],
    axes: int,
) -> tuple[Tensor, Tensor]:
    table = cells.new_empty((len(taps), len(cells)), dtype=torch.int32)
    bits = torch.empty_like(cells)
    if len(cells) > 0:
        with torch.cuda.device_of(keys):
            _search[(triton.cdiv(len(cells), CELLS),)](
                *(keys, cells, taps, table, bits, plan, shifts),
                *(len(keys), len(cells), len(taps), len(keys).bit_length(), *samples),
                AXES=axes,
                NONE=NONE,
                BITS=ORDERING_TAPS,
                BLOCK=CELLS,
                num_warps=4,
            )
    return table, bits


def stacked_table_triton(
    table: Tensor,  # [K, m] int32
    places: tuple[Tensor, Tensor],  # [m] integer each
    first: int,
) -> tuple[Tensor, Tensor]:  # [2 K, m] int32, [m] int64
    """The reference's table and bits."""
    if not runs_kernels(table):
        return stacked_table_reference(table, places, first)
    taps, cells = table.shape
    out, bits = table.new_empty(2 * taps, cells), table.new_empty(cells, dtype=torch.int64)
    if cells > 0:
        with torch.cuda.device_of(table):
            _stack[(triton.cdiv(cells, CELLS),)](
                *(table.contiguous(), *(place.contiguous() for place in places), out, bits, first, cells, taps),
                BITS=ORDERING_TAPS,
                BLOCK=CELLS,
                num_warps=4,
            )
    return out, bits


def transposed_table_triton(
    table: Tensor,  # [K, m] int32
    num: int,
) -> tuple[Tensor, Tensor]:  # [K, num] int32, [num] int64
    """The reference's table and bits."""
    if not runs_kernels(table):
        return transposed_table_reference(table, num)
    back, bits = table.new_full((len(table), num), -1), table.new_zeros(num, dtype=torch.int64)
    cells = table.shape[1]
    if cells > 0 and num > 0:
        with torch.cuda.device_of(table):
            _turn[(triton.cdiv(cells, CELLS), len(table))](
                *(table.contiguous(), back, bits, num, cells),
                BITS=ORDERING_TAPS,
                BLOCK=CELLS,
                num_warps=4,
            )
    return back, bits


@triton.jit(do_not_specialize=["num", "cells", "all_taps", "steps", "old_step", "new_step"])
def _search(  # noqa: ANN202
    keys, corners, taps, table, bits, plan, shifts, num, cells, all_taps, steps, old_step, new_step,  # noqa: ANN001
    AXES: tl.constexpr, NONE: tl.constexpr, BITS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """All taps of a block of cells."""
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = place < cells
    corner = tl.load(corners + place, mask=live, other=0)
    if AXES > 0:
        corner = moved_key(corner, plan, shifts, old_step, new_step, AXES, NONE)
    seen = tl.zeros((BLOCK,), tl.int64)
    for tap in range(0, all_taps):
        wanted = corner + tl.load(taps + tap)
        low = lower_bound(keys, wanted, num, steps, BLOCK)
        inside = low < num
        found = inside & (tl.load(keys + low, mask=inside, other=0) == wanted)
        tl.store(table + tap * cells + place, tl.where(found, low, -1), mask=live)
        if tap < BITS:
            seen += found.to(tl.int64) << tap
    tl.store(bits + place, seen, mask=live)


@triton.jit(do_not_specialize=["first", "cells", "taps"])
def _stack(  # noqa: ANN202
    table, own, other, out, bits, first, cells, taps,  # noqa: ANN001
    BITS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """All taps of a block of cells in either part."""
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = place < cells
    seen = tl.zeros((BLOCK,), tl.int64)
    for tap in range(0, 2 * taps):
        row = tl.load(table + tap % taps * cells + place, mask=live, other=-1)
        known = row >= 0
        mine = tl.load(own + row, mask=known & (tap < taps), other=-1)
        theirs = tl.load(other + row, mask=known & (tap >= taps), other=-1)
        found = tl.where(mine >= 0, mine, tl.where(theirs >= 0, theirs + first, -1))
        tl.store(out + tap * cells + place, found, mask=live)
        if tap < BITS:
            seen += (found >= 0).to(tl.int64) << tap
    tl.store(bits + place, seen, mask=live)


@triton.jit(do_not_specialize=["num", "cells"])
def _turn(table, back, bits, num, cells, BITS: tl.constexpr, BLOCK: tl.constexpr):  # noqa: ANN001, ANN202
    """One tap of a block of cells. No two write to the same place, and bits are set whatever the order."""
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    tap = tl.program_id(1)
    row = tl.load(table + tap.to(tl.int64) * cells + place, mask=place < cells, other=-1)
    seen = row >= 0
    tl.store(back + tap.to(tl.int64) * num + row, place, mask=seen)
    if tap < BITS:
        tl.atomic_or(bits + row, tl.full((BLOCK,), 1, tl.int64) << tap, mask=seen)
