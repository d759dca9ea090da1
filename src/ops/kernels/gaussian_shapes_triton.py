"""Sampling points and refined attributes of Gaussians by a Triton launch each (method 5.2, 5.4)."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from src.ops.backend import runs_kernels
from src.ops.gaussian_shapes import (
    LEARNABLE_REACH,
    LEAST_LENGTH,
    AttributeLimits,
    refined_attributes_reference,
    sampling_points_reference,
)

LANES = 128
"""Points or Gaussians of a program, one lane each."""


def sampling_points_triton(
    offsets: Tensor,  # [B, G, 2 K]
    fixed: Tensor,  # [F, 2]
    means: Tensor,  # [B, G, 2]
    scales: Tensor,  # [B, G, 2]
    directions: Tensor,  # [B, G, 2]
) -> Tensor:  # [B, G, F + K, 2]
    """The reference's points up to rounding."""
    inputs = (offsets, fixed, means, scales, directions)
    if any(x.dtype != torch.float32 for x in inputs) or not runs_kernels(means):
        return sampling_points_reference(*inputs)
    num, learnt = len(fixed), offsets.shape[2] // 2
    out = means.new_empty(*means.shape[:2], num + learnt, 2)
    if out.numel() > 0:
        with torch.cuda.device_of(out):
            _spread[(triton.cdiv(out.numel() // 2, LANES),)](
                *(x.contiguous() for x in inputs),
                *(out, out.numel() // 2, num, learnt, LEARNABLE_REACH),
                BLOCK=LANES,
                num_warps=4,
            )
    return out


def refined_attributes_triton(
    raw: Tensor,  # [B, G, 9]
    means: Tensor,  # [B, G, 2]
    lower_m: Tensor,  # [2]
    upper_m: Tensor,  # [2]
    limits: AttributeLimits,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # [B, G, 2] each
    """The reference's attributes up to rounding."""
    inputs = (raw, means, lower_m, upper_m)
    if any(x.dtype != torch.float32 for x in inputs) or not runs_kernels(raw):
        return refined_attributes_reference(*inputs, limits)
    out = means.new_empty(4, *means.shape)
    if out.numel() > 0:
        (low, high), unit = limits.scale_range_m, limits.velocity_unit_mps / limits.max_speed_mps
        with torch.cuda.device_of(out):
            _refine[(triton.cdiv(means.numel() // 2, LANES),)](
                *(x.contiguous() for x in inputs),
                *(out, means.numel() // 2, low, high - low, limits.max_mean_shift_m, limits.max_speed_mps, unit),
                LEAST_LENGTH,
                BLOCK=LANES,
                num_warps=4,
            )
    return out.unbind(0)


@triton.jit(do_not_specialize=["points", "num", "learnt"])
def _spread(  # noqa: ANN202
    offsets, fixed, means, scales, directions, out, points, num, learnt, reach,  # noqa: ANN001
    BLOCK: tl.constexpr,
):  # fmt: skip
    """A block of points of all Gaussians."""
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = place < points
    gaussian, own = place // (num + learnt), place % (num + learnt)
    known, free = live & (own < num), live & (own >= num)
    logit = offsets + 2 * (gaussian * learnt + own - num)
    along = reach * (1.0 / (1.0 + tl.exp(-tl.load(logit, mask=free, other=0.0))) - 0.5)
    across = reach * (1.0 / (1.0 + tl.exp(-tl.load(logit + 1, mask=free, other=0.0))) - 0.5)
    along = tl.where(known, tl.load(fixed + 2 * own, mask=known, other=0.0), along)
    across = tl.where(known, tl.load(fixed + 2 * own + 1, mask=known, other=0.0), across)
    along *= tl.load(scales + 2 * gaussian, mask=live, other=0.0)
    across *= tl.load(scales + 2 * gaussian + 1, mask=live, other=0.0)
    cosine = tl.load(directions + 2 * gaussian, mask=live, other=0.0)
    sine = tl.load(directions + 2 * gaussian + 1, mask=live, other=0.0)
    x = tl.load(means + 2 * gaussian, mask=live, other=0.0) + cosine * along - sine * across
    y = tl.load(means + 2 * gaussian + 1, mask=live, other=0.0) + sine * along + cosine * across
    tl.store(out + 2 * place, x, mask=live)
    tl.store(out + 2 * place + 1, y, mask=live)


@triton.jit(do_not_specialize=["num"])
def _refine(  # noqa: ANN202
    raw, means, lower, upper, out, num, low, span, max_shift, max_speed, unit, least,  # noqa: ANN001
    BLOCK: tl.constexpr,
):  # fmt: skip
    """All attributes of a block of Gaussians."""
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = place < num
    turn_x = tl.load(raw + 9 * place + 4, mask=live, other=0.0)
    turn_y = tl.load(raw + 9 * place + 5, mask=live, other=0.0)
    length = tl.maximum(tl.sqrt(turn_x * turn_x + turn_y * turn_y), least)
    for axis in tl.static_range(2):
        shift = tl.load(raw + 9 * place + axis, mask=live, other=0.0)
        mean = tl.load(means + 2 * place + axis, mask=live, other=0.0)
        mean += max_shift * (2.0 / (1.0 + tl.exp(-shift)) - 1.0)
        mean = tl.minimum(tl.maximum(mean, tl.load(lower + axis)), tl.load(upper + axis))
        scale = low + span / (1.0 + tl.exp(-tl.load(raw + 9 * place + 2 + axis, mask=live, other=0.0)))
        speed = tl.load(raw + 9 * place + 7 + axis, mask=live, other=0.0) * unit
        speed = max_speed * (2.0 / (1.0 + tl.exp(-2.0 * speed)) - 1.0)
        turn = (turn_x if axis == 0 else turn_y) / length
        tl.store(out + 2 * place + axis, mean, mask=live)
        tl.store(out + 2 * (num + place) + axis, scale, mask=live)
        tl.store(out + 2 * (2 * num + place) + axis, turn, mask=live)
        tl.store(out + 2 * (3 * num + place) + axis, speed, mask=live)
