"""Sums or means of groups of rows by one Triton launch, and rows gathered by another."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from src.ops.backend import runs_kernels
from src.ops.distinct_keys import Groups
from src.ops.segment_reduce import gather_rows_reference, group_sum_reference

ROWS = 16
"""Gathered rows of a program."""
VALUES = 256
"""Sums of a program, of as many groups as have them: most groups are of few rows, or padding."""


def group_sum_triton(values: Tensor, groups: Groups, mean: bool) -> Tensor:
    """The reference's sums; those of float16 and bfloat16 are added in float32."""
    if values.dtype == torch.float64 or not runs_kernels(values):
        return group_sum_reference(values, groups, mean)
    num, channels = len(groups.starts) - 1, values.shape[1]
    out = values.new_empty(num, channels)
    if out.numel() > 0:
        with torch.cuda.device_of(values):
            block = triton.next_power_of_2(channels)
            together = max(1, VALUES // block)
            _sum_groups[(triton.cdiv(num, together),)](
                *(values.contiguous(), *groups, out, num, channels, mean),
                GROUPS=together,
                BLOCK=block,
                num_warps=1,
            )
    return out


def gather_rows_triton(values: Tensor, rows: Tensor) -> Tensor:
    """The reference's rows."""
    if not runs_kernels(values):
        return gather_rows_reference(values, rows)
    num, channels = len(rows), values.shape[1]
    out = values.new_empty(num, channels)
    if out.numel() > 0:
        with torch.cuda.device_of(values):
            _take[(triton.cdiv(num, ROWS),)](
                *(values.contiguous(), rows.contiguous(), out, num, channels),
                ROWS=ROWS,
                BLOCK=triton.next_power_of_2(channels),
                num_warps=4,
            )
    return out


@triton.jit(do_not_specialize=["num"])
def _take(values, rows, out, num, channels, ROWS: tl.constexpr, BLOCK: tl.constexpr):  # noqa: ANN001, ANN202
    """A block of rows."""
    place = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    lane = tl.arange(0, BLOCK)[None]
    row = tl.load(rows + place, mask=place < num, other=-1).to(tl.int64)[:, None]
    found = tl.load(values + row * channels + lane, mask=(row >= 0) & (lane < channels), other=0)
    place = place[:, None]
    tl.store(out + place * channels + lane, found, mask=(place < num) & (lane < channels))


@triton.jit(do_not_specialize=["num"])
def _sum_groups(  # noqa: ANN202
    values, order, starts, out, num, channels, MEAN: tl.constexpr, GROUPS: tl.constexpr, BLOCK: tl.constexpr  # noqa: ANN001
):  # fmt: skip
    """Some groups side by side, each row by row."""
    group = tl.program_id(0).to(tl.int64) * GROUPS + tl.arange(0, GROUPS)
    lane = tl.arange(0, BLOCK)[None]
    first = tl.load(starts + group, mask=group < num, other=0)
    count = tl.load(starts + group + 1, mask=group < num, other=0) - first
    total = tl.zeros((GROUPS, BLOCK), tl.float32)
    for place in range(0, tl.max(count, 0)):
        row = tl.load(order + first + place, mask=place < count, other=0)[:, None]
        live = (place < count)[:, None] & (lane < channels)
        total += tl.load(values + row * channels + lane, mask=live, other=0.0).to(tl.float32)
    if MEAN:
        total = total / tl.maximum(count, 1).to(tl.float32)[:, None]
    group = group[:, None]
    tl.store(out + group * channels + lane, total, mask=(group < num) & (lane < channels))
