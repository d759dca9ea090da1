"""Farthest point sampling as one Triton program a sample (method 6.2)."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from src.ops.backend import runs_kernels
from src.ops.farthest_point import farthest_points_reference

# A sample's points and gaps stay in registers: beyond this many they would spill, and the reference takes over.
MOST_POINTS = 8192
POINTS_PER_WARP = 512


def farthest_points_triton(
    points: Tensor,  # [B, G, 2] m
    valid: Tensor,  # [B, G] bool
    start: Tensor,  # [B] int64
    count: int,
) -> Tensor:  # [B, count] int64
    """The picks of the reference, all of a sample in one launch; takes float32 and at most MOST_POINTS points."""
    b, g = valid.shape
    if points.dtype != torch.float32 or g > MOST_POINTS or not runs_kernels(points):
        return farthest_points_reference(points, valid, start, count)
    picks = torch.full((b, count), -1, dtype=start.dtype, device=points.device)
    if picks.numel() == 0 or g == 0:
        return picks
    block = triton.next_power_of_2(g)
    with torch.cuda.device_of(points):
        _sample[(b,)](
            points.contiguous(),
            valid.contiguous().view(torch.uint8),
            start.contiguous(),
            picks,
            g,
            count,
            BLOCK=block,
            num_warps=max(block // POINTS_PER_WARP, 1),
            # x*x + y*y rounded once per step, as torch rounds it: ties and near-ties fall as in the reference.
            enable_fp_fusion=False,
        )
    return picks


@triton.jit
def _sample(points, valid, start, picks, num, count, BLOCK: tl.constexpr):  # noqa: ANN001, ANN202
    sample = tl.program_id(0)
    row = tl.arange(0, BLOCK)
    live = row < num
    corner = points + sample * num * 2
    x = tl.load(corner + row * 2, mask=live, other=0.0)
    y = tl.load(corner + row * 2 + 1, mask=live, other=0.0)
    usable = tl.load(valid + sample * num + row, mask=live, other=0) != 0
    # Squared distance to the nearest pick; -1: not to be picked (again), -2: no point at all.
    gap = tl.where(usable, float("inf"), tl.where(live, -1.0, -2.0))
    pick = tl.load(start + sample).to(tl.int32)
    best = tl.max(tl.where(row == pick, gap, -2.0), 0)
    step = 0
    while (step < count) & (best >= 0):
        tl.store(picks + sample * count + step, pick.to(tl.int64))
        across = x - tl.load(corner + pick * 2)
        along = y - tl.load(corner + pick * 2 + 1)
        gap = tl.where(gap >= 0, tl.minimum(gap, across * across + along * along), gap)
        gap = tl.where(row == pick, -1.0, gap)
        best, pick = tl.max(gap, 0, return_indices=True)  # ties by the lowest row
        step += 1
