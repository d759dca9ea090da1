"""Distinct keys by a sort and two Triton launches: how many each block of keys begins, and where they go."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from src.ops.backend import runs_kernels
from src.ops.distinct_keys import Groups, distinct_keys_reference, grouped_keys_reference

KEYS = 1024
"""Keys of a program."""
MOST_ALONE = 4096
"""Keys that one program takes, which needs no count of others."""


def distinct_keys_triton(keys: Tensor, end: int, size: int) -> Tensor:
    """The reference's keys."""
    if not runs_kernels(keys) or len(keys) == 0:
        return distinct_keys_reference(keys, end, size)
    ordered = keys.sort().values
    found = ordered.new_empty(size)
    _write(ordered, ordered, found, found, found, end, False)
    return found


def grouped_keys_triton(keys: Tensor, end: int, size: int) -> tuple[Tensor, Tensor, Groups]:
    """The reference's groups; the places of padding are others."""
    if not runs_kernels(keys) or len(keys) == 0:
        return grouped_keys_reference(keys, end, size)
    ordered, order = keys.sort(stable=True)
    found, rows, starts = (ordered.new_empty(count) for count in (size, len(keys), size + 1))
    _write(ordered, order, found, rows, starts, end, True)
    return found, rows, Groups(order, starts)


def _write(
    ordered: Tensor,  # [n] int64
    order: Tensor,  # [n] int64; it and the last two are of no meaning without groups
    found: Tensor,  # [size] int64, to fill
    rows: Tensor,  # [n] int64, to fill
    starts: Tensor,  # [size + 1] int64, to fill
    end: int,
    grouped: bool,
) -> None:
    num = len(ordered)
    alone = num < MOST_ALONE
    size = triton.next_power_of_2(num + 1) if alone else KEYS
    blocks = triton.cdiv(num + 1, size)  # one more, for the end of the last group
    counts = ordered.new_empty((2, blocks), dtype=torch.int32)
    with torch.cuda.device_of(ordered):
        if not alone:
            _count_firsts[(blocks,)](ordered, counts, num, end, blocks, BLOCK=size, num_warps=4)
        _write_groups[(blocks,)](
            *(ordered, order, counts, found, rows, starts, num, len(found), end, blocks),
            ALONE=alone,
            GROUPED=grouped,
            COUNTS=triton.next_power_of_2(blocks),
            BLOCK=size,
            num_warps=4,
        )


@triton.jit
def _firsts(ordered, num, end, place):  # noqa: ANN001, ANN202
    """The keys at these places, which are below `end`, and which of those are the first of equal ones."""
    live = place < num
    key = tl.load(ordered + place, mask=live, other=0)
    before = tl.load(ordered + place - 1, mask=live & (place > 0), other=0)
    known = live & (key < end)
    return key, known, known & ((place == 0) | (key != before))


@triton.jit(do_not_specialize=["num", "end", "blocks"])
def _count_firsts(ordered, counts, num, end, blocks, BLOCK: tl.constexpr):  # noqa: ANN001, ANN202
    """How many distinct keys a block begins, and how many of its keys are below `end`."""
    block = tl.program_id(0)
    key, known, first = _firsts(ordered, num, end, block * BLOCK + tl.arange(0, BLOCK))
    tl.store(counts + block, tl.sum(first.to(tl.int32), 0))
    tl.store(counts + blocks + block, tl.sum(known.to(tl.int32), 0))


@triton.jit(do_not_specialize=["num", "size", "end", "blocks"])
def _write_groups(  # noqa: ANN202
    ordered, order, counts, found, rows, starts, num, size, end, blocks,  # noqa: ANN001
    ALONE: tl.constexpr, GROUPED: tl.constexpr, COUNTS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """The distinct keys that a block begins, and its part of what stands behind the last."""
    block = tl.program_id(0)
    place = block * BLOCK + tl.arange(0, BLOCK)
    key, known, first = _firsts(ordered, num, end, place)
    one = first.to(tl.int32)
    if ALONE:
        before = 0
        total = tl.sum(one, 0)
        below = tl.sum(known.to(tl.int32), 0)
    else:
        other = tl.arange(0, COUNTS)
        begun = tl.load(counts + other, mask=other < blocks, other=0)
        before = tl.sum(tl.where(other < block, begun, 0), 0)
        total = tl.sum(begun, 0)
        below = tl.sum(tl.load(counts + blocks + other, mask=other < blocks, other=0), 0)
    row = before + tl.cumsum(one, 0) - 1
    kept = first & (row < size)
    behind = place >= total
    tl.store(found + row, key, mask=kept)
    tl.store(found + place, end, mask=behind & (place < size))
    if GROUPED:
        tl.store(starts + row, place.to(tl.int64), mask=kept)
        tl.store(starts + place, below.to(tl.int64), mask=(behind | (place == size)) & (place <= size))
        own = tl.minimum(tl.where(known, row, total), size - 1)
        given = tl.load(order + place, mask=place < num, other=0)
        tl.store(rows + given, own.to(tl.int64), mask=place < num)
