"""Keys of sites on another grid by one Triton launch."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from src.geometry.constants import constant
from src.ops.backend import runs_kernels
from src.ops.moved_keys import NONE, Axis, moved_keys_reference

SITES = 256
"""Sites of a program, one lane each."""


def moved_keys_triton(
    keys: Tensor,  # [n] int64
    samples: tuple[int, int],
    axes: tuple[Axis, ...],
    shifts: tuple[tuple[int, ...], ...],
) -> Tensor:  # [K, n] int64
    """The reference's keys."""
    if not runs_kernels(keys):
        return moved_keys_reference(keys, samples, axes, shifts)
    out = keys.new_empty(len(shifts), len(keys))
    if out.numel() > 0:
        plan, taps = (constant(rows, torch.int64, keys.device) for rows in (axes, shifts))
        with torch.cuda.device_of(keys):
            _move[(triton.cdiv(len(keys), SITES), len(shifts))](
                *(keys, plan, taps, out, len(keys), *samples),
                AXES=len(axes),
                NONE=NONE,
                BLOCK=SITES,
                num_warps=4,
            )
    return out


@triton.jit
def moved_key(key, plan, shifts, old_step, new_step, AXES: tl.constexpr, NONE: tl.constexpr):  # noqa: ANN001, ANN201
    """The keys moved by one tap's shifts."""
    total = key // old_step * new_step
    fits = key == key
    for axis in tl.static_range(AXES):
        row = plan + 7 * axis
        divisor = tl.load(row + 3)
        cell = key // tl.load(row) % tl.load(row + 1)
        # Eight divisors more, so that the division of integers, which cuts towards zero, meets nothing negative.
        moved = cell * tl.load(row + 2) + tl.load(shifts + axis) + 8 * divisor
        target = moved // divisor - 8
        fits = fits & (moved % divisor == 0) & (target >= tl.load(row + 4)) & (target < tl.load(row + 5))
        total += target * tl.load(row + 6)
    return tl.where(fits, total, NONE)


@triton.jit(do_not_specialize=["num", "old_step", "new_step"])
def _move(  # noqa: ANN202
    keys, plan, taps, out, num, old_step, new_step,  # noqa: ANN001
    AXES: tl.constexpr, NONE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """One tap of a block of sites."""
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    tap = tl.program_id(1)
    key = tl.load(keys + place, mask=place < num, other=0)
    found = moved_key(key, plan, taps + tap * AXES, old_step, new_step, AXES, NONE)
    tl.store(out + tap * num + place, found, mask=place < num)
