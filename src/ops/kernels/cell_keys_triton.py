"""Keys of the cells that points lie in by one Triton launch, and centres of the cells of keys by another."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.geometry.constants import constant
from src.ops.backend import runs_kernels
from src.ops.cell_keys import cell_centres_reference, cell_keys_reference
from src.ops.sites import Sites

POINTS = 256
"""Points of a program, one lane each."""


def cell_keys_triton(
    points: Tensor,  # [n, d]
    samples: Tensor,  # [m] int64
    valid: Tensor | None,  # [n] bool
    lower_m: tuple[float, ...],
    size_m: tuple[float, ...],
    shape: tuple[int, ...],
    dtype: torch.dtype,
    behind: int = 0,
) -> Tensor:  # [n + behind] int64
    """The reference's keys."""
    if not runs_kernels(points):
        return cell_keys_reference(points, samples, valid, lower_m, size_m, shape, dtype, behind)
    sites = Sites(tuple(shape), samples)
    num, ndim = points.shape
    points = points if points.stride(1) == 1 else points.contiguous()
    out = samples.new_empty(num + behind)
    if len(out) > 0:
        frame = constant((tuple(lower_m), tuple(size_m)), dtype, points.device)
        axes = tuple(zip(reversed(shape[1:]), reversed(sites.strides[1:]), strict=True))  # as the points have them
        limits = constant(axes, torch.int64, points.device)
        known = points if valid is None else valid.contiguous().view(torch.uint8)
        with torch.cuda.device_of(points):
            _locate[(triton.cdiv(len(out), POINTS),)](
                *(points, samples.contiguous(), known, frame, limits, out, num, len(out), points.stride(0)),
                *(max(num // max(len(samples), 1), 1), sites.strides[0], sites.end),
                CHECKED=valid is not None,
                DOUBLE=dtype == torch.float64,
                AXES=ndim,
                BLOCK=POINTS,
                num_warps=4,
            )
    return out


def cell_centres_triton(keys: Tensor, grid: BEVGrid) -> Tensor:
    """The reference's centres up to rounding."""
    if not runs_kernels(keys):
        return cell_centres_reference(keys, grid)
    out = keys.new_empty((len(keys), 2), dtype=torch.float32)
    if len(keys) > 0:
        sample, row, _ = Sites((1, *grid.cells), keys).strides
        with torch.cuda.device_of(keys):
            _centre[(triton.cdiv(len(keys), POINTS),)](
                *(keys, out, len(keys), sample, row, grid.x_min_m, grid.y_min_m, grid.cell_m),
                BLOCK=POINTS,
                num_warps=4,
            )
    return out


@triton.jit(do_not_specialize=["num", "sample_step", "row_step"])
def _centre(keys, out, num, sample_step, row_step, x_min, y_min, cell_m, BLOCK: tl.constexpr):  # noqa: ANN001, ANN202
    """A block of keys."""
    place = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = place < num
    key = tl.load(keys + place, mask=live, other=0) % sample_step
    tl.store(out + 2 * place, x_min + ((key % row_step).to(tl.float32) + 0.5) * cell_m, mask=live)
    tl.store(out + 2 * place + 1, y_min + ((key // row_step).to(tl.float32) + 0.5) * cell_m, mask=live)


@triton.jit(do_not_specialize=["num", "total", "width", "per_sample", "sample_step", "end"])
def _locate(  # noqa: ANN202
    points, samples, valid, frame, limits, out, num, total, width, per_sample, sample_step, end,  # noqa: ANN001
    CHECKED: tl.constexpr, DOUBLE: tl.constexpr, AXES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """A block of points; dtype of the frame."""
    place = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = place < num
    key = tl.load(samples + place // per_sample, mask=inside, other=0) * sample_step
    if CHECKED:
        inside = inside & (tl.load(valid + place, mask=inside, other=0) > 0)
    for axis in tl.static_range(AXES):
        lower, size = tl.load(frame + axis), tl.load(frame + AXES + axis)
        value = tl.load(points + place * width + axis, mask=inside, other=0.0).to(lower.dtype) - lower
        if DOUBLE:
            cell = tl.floor(value / size)
        else:  # where Triton's own division is not exact
            cell = tl.floor(tl.div_rn(value, size))
        inside = inside & (cell >= 0) & (cell < tl.load(limits + 2 * axis))
        key += tl.where(inside, cell, 0.0).to(tl.int64) * tl.load(limits + 2 * axis + 1)
    tl.store(out + place, tl.where(inside & (key < end), key, end), mask=place < total)
