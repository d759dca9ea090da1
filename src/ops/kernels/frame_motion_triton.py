"""Motion of remembered frames, in float64, and of their Gaussians by a Triton launch each (method 6)."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.ops.backend import runs_kernels
from src.ops.frame_motion import Pose, Shapes, relative_motion_reference, warp_gaussians_reference

GAUSSIANS = 128
"""Gaussians of a program, one lane each."""


def relative_motion_triton(
    now: Pose, aug_from_ego: Tensor, past: Pose, present: Tensor, max_age_s: float, max_speed_mps: float, newest: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The reference's motion up to rounding."""
    if any(x.dtype != torch.float64 for x in (*now, *past)) or not runs_kernels(present):
        return relative_motion_reference(now, aug_from_ego, past, present, max_age_s, max_speed_mps, newest)
    shape, streams = present.shape, len(now[1])
    matrix = aug_from_ego.new_empty(*shape, 4, 4, dtype=torch.float32)
    elapsed = matrix.new_empty(shape)
    flags = present.new_empty((2, *shape), dtype=torch.uint8)
    if present.numel() > 0:
        poses, times = past[0].reshape(-1, streams, 4, 4), past[1].reshape(-1, streams)
        poses = poses if poses.stride()[2:] == (4, 1) else poses.contiguous()
        with torch.cuda.device_of(present):
            _relate[(present.numel(),)](
                *(now[0].contiguous(), now[1].contiguous(), aug_from_ego.contiguous(), poses, times),
                *(present.contiguous().view(torch.uint8), matrix, elapsed, flags),
                *(present.numel(), streams, *poses.stride()[:2], *times.stride()),
                NEWEST=newest,
                MAX_AGE=max_age_s,
                MAX_SPEED=max_speed_mps,
                num_warps=1,
            )
    kept, usable = flags.view(torch.bool).unbind(0)
    return kept, matrix, elapsed, usable


def warp_gaussians_triton(
    shapes: Shapes, valid: Tensor, aug_from_past: Tensor, elapsed_s: Tensor, usable: Tensor,
    min_speed_mps: float | None, grid: BEVGrid,
) -> tuple[Shapes, Tensor]:  # fmt: skip
    """The reference's Gaussians up to rounding."""
    inputs = (*shapes, aug_from_past, elapsed_s)
    if any(x.dtype != torch.float32 for x in inputs) or not runs_kernels(valid):
        return warp_gaussians_reference(shapes, valid, aug_from_past, elapsed_s, usable, min_speed_mps, grid)
    (frames, num), total = valid.shape, valid.numel()
    out = aug_from_past.new_empty(4, frames, num, 2)
    moved = valid.new_empty((frames, num), dtype=torch.uint8)
    if total > 0:
        rows = [_rows(x) for x in shapes]
        with torch.cuda.device_of(valid):
            _move_gaussians[(triton.cdiv(total, GAUSSIANS),)](
                *(*rows, valid.contiguous().view(torch.uint8), aug_from_past.contiguous(), elapsed_s.contiguous()),
                *(usable.contiguous().view(torch.uint8), out, moved, total, num, *(x.stride(0) for x in rows)),
                *(grid.rows, grid.cols, grid.x_min_m, grid.y_min_m, grid.cell_m, *grid.centre_m),
                0.0 if min_speed_mps is None else min_speed_mps,
                DRIVEN=min_speed_mps is not None,
                BLOCK=GAUSSIANS,
                num_warps=4,
            )
    return out.unbind(0), moved.view(torch.bool)


def _rows(
    pairs: Tensor,  # [N, n, 2]
) -> Tensor:  # [N * n, 2], the pair of each row side by side
    """Columns of one tensor are not copied."""
    rows = pairs.flatten(0, 1)
    return rows if rows.stride(1) == 1 else rows.contiguous()


@triton.jit
def _way(now, then, AXIS: tl.constexpr):  # noqa: ANN001, ANN202
    """From one pose to the origin of another, along an axis of the first."""
    way = tl.load(now + AXIS) * (tl.load(then + 3) - tl.load(now + 3))
    way += tl.load(now + 4 + AXIS) * (tl.load(then + 7) - tl.load(now + 7))
    return way + tl.load(now + 8 + AXIS) * (tl.load(then + 11) - tl.load(now + 11))


@triton.jit
def _driven(now, then, age, MAX_SPEED: tl.constexpr):  # noqa: ANN001, ANN202
    """Whether a vehicle can get from one pose to the other in that time."""
    x, y, z = _way(now, then, 0), _way(now, then, 1), _way(now, then, 2)
    return (age > 0.0) & (tl.sqrt(x * x + y * y + z * z) <= MAX_SPEED * age)


@triton.jit(do_not_specialize=["num", "streams", "pose_frame", "pose_stream", "time_frame", "time_stream"])
def _relate(  # noqa: ANN202
    now, now_s, aug, poses, times, present, matrix, elapsed, flags,  # noqa: ANN001
    num, streams, pose_frame, pose_stream, time_frame, time_stream,  # noqa: ANN001
    NEWEST: tl.constexpr, MAX_AGE: tl.constexpr, MAX_SPEED: tl.constexpr,
):  # fmt: skip
    """One frame of one stream, a lane for each entry of its matrix."""
    place = tl.program_id(0)
    frame, stream = place // streams, place % streams
    now += 16 * stream
    then = poses + frame * pose_frame + stream * pose_stream
    age = tl.load(now_s + stream) - tl.load(times + frame * time_frame + stream * time_stream)
    kept = tl.load(present + place) > 0
    if NEWEST:
        first = tl.load(now_s + stream) - tl.load(times + stream * time_stream)
        steady = _driven(now, poses + stream * pose_stream, first, MAX_SPEED)
        kept = kept & (age > 0.0) & (steady | (first <= 0.0) | (tl.load(present + stream) == 0))
    usable = kept & _driven(now, then, age, MAX_SPEED) & (age <= MAX_AGE)
    lane = tl.arange(0, 16)
    row, col = lane // 4, lane % 4
    total = tl.where(col == 3, tl.load(aug + 16 * stream + 4 * row + 3).to(tl.float64), 0.0)
    for inner in tl.static_range(3):
        entry = tl.zeros((16,), tl.float64)
        for axis in tl.static_range(3):
            origin = tl.where(col == 3, tl.load(now + 4 * axis + 3), 0.0)
            entry += tl.load(now + 4 * axis + inner) * (tl.load(then + 4 * axis + col) - origin)
        total += tl.load(aug + 16 * stream + 4 * row + inner).to(tl.float64) * entry
    total = tl.where(usable, total, tl.where(row == col, 1.0, 0.0))
    tl.store(matrix + 16 * place + lane, total.to(tl.float32))
    tl.store(elapsed + place, tl.where(usable, age, 0.0).to(tl.float32))
    tl.store(flags + place, kept.to(tl.uint8))
    tl.store(flags + num + place, usable.to(tl.uint8))


@triton.jit(
    do_not_specialize=["total", "num", "mean_step", "scale_step", "turn_step", "speed_step", "grid_rows", "grid_cols"]
)
def _move_gaussians(  # noqa: ANN202
    means, scales, turns, speeds, valid, matrices, elapsed, usable, out, moved,  # noqa: ANN001
    total, num, mean_step, scale_step, turn_step, speed_step,  # noqa: ANN001
    grid_rows, grid_cols, x_min, y_min, cell_m, centre_x, centre_y, min_speed,  # noqa: ANN001
    DRIVEN: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """A block of Gaussians of all frames."""
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = place < total
    frame, row = place // num, place.to(tl.int64)
    matrix = matrices + 16 * frame
    xx, xy = tl.load(matrix, mask=live, other=1.0), tl.load(matrix + 1, mask=live, other=0.0)
    yx, yy = tl.load(matrix + 4, mask=live, other=0.0), tl.load(matrix + 5, mask=live, other=1.0)
    x = tl.load(means + row * mean_step, mask=live, other=0.0)
    y = tl.load(means + row * mean_step + 1, mask=live, other=0.0)
    speed_x = tl.load(speeds + row * speed_step, mask=live, other=0.0)
    speed_y = tl.load(speeds + row * speed_step + 1, mask=live, other=0.0)
    if DRIVEN:
        age = tl.load(elapsed + frame, mask=live, other=0.0)
        age = tl.where(tl.sqrt(speed_x * speed_x + speed_y * speed_y) >= min_speed, age, 0.0)
        x, y = x + speed_x * age, y + speed_y * age
    new_x = xx * x + xy * y + tl.load(matrix + 3, mask=live, other=0.0)
    new_y = yx * x + yy * y + tl.load(matrix + 7, mask=live, other=0.0)
    col, line = tl.div_rn(new_x - x_min, cell_m), tl.div_rn(new_y - y_min, cell_m)
    here = live & (tl.load(valid + place, mask=live, other=0) > 0) & (tl.load(usable + frame, mask=live, other=0) > 0)
    here = here & (col >= 0.0) & (col < grid_cols) & (line >= 0.0) & (line < grid_rows)
    tl.store(moved + place, here.to(tl.uint8), mask=live)
    tl.store(out + 2 * place, tl.where(here, new_x, centre_x), mask=live)
    tl.store(out + 2 * place + 1, tl.where(here, new_y, centre_y), mask=live)
    growth = tl.sqrt(tl.abs(xx * yy - xy * yx))
    out += 2 * total
    tl.store(out + 2 * place, tl.load(scales + row * scale_step, mask=live, other=0.0) * growth, mask=live)
    tl.store(out + 2 * place + 1, tl.load(scales + row * scale_step + 1, mask=live, other=0.0) * growth, mask=live)
    turn_x = tl.load(turns + row * turn_step, mask=live, other=0.0)
    turn_y = tl.load(turns + row * turn_step + 1, mask=live, other=0.0)
    ahead_x, ahead_y = xx * turn_x + xy * turn_y, yx * turn_x + yy * turn_y
    length = tl.maximum(tl.sqrt(ahead_x * ahead_x + ahead_y * ahead_y), 1e-12)
    out += 2 * total
    tl.store(out + 2 * place, ahead_x / length, mask=live)
    tl.store(out + 2 * place + 1, ahead_y / length, mask=live)
    out += 2 * total
    tl.store(out + 2 * place, xx * speed_x + xy * speed_y, mask=live)
    tl.store(out + 2 * place + 1, yx * speed_x + yy * speed_y, mask=live)
