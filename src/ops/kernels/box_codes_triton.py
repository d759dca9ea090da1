"""Boxes from their codes by two launches: one Triton kernel, and the angle, which Triton has no function for."""

from __future__ import annotations

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.geometry.constants import Values, constant
from src.ops.backend import runs_kernels
from src.ops.box_codes import (
    ATTRIBUTE_MOVING_MPS,
    DRIVING_MPS,
    LEAST_COSINE,
    LOG_SIZE_LIMIT,
    OVERHEAD_M,
    WIDTHS,
    YAW,
    decoded_boxes_reference,
)
from src.ops.kernels.radial_correction_triton import nearest_radial
from src.ops.radial_correction import BIN_MPS, MIN_SPEED_MPS, NEAR_BINS, NUM_BINS

BOXES = 32
"""Boxes of a program, one lane each."""


def decoded_boxes_triton(
    codes: Tensor, rows: Tensor, indices: Tensor, labels: Tensor, scores: Tensor, threshold: float, grid: BEVGrid,
    rules: Values, radar: tuple[Tensor, Tensor] | None, turned: bool,
) -> Tensor:  # fmt: skip
    """The reference's boxes up to rounding."""
    if any(x.dtype != torch.float32 for x in (codes, scores)) or not runs_kernels(codes):
        return decoded_boxes_reference(codes, rows, indices, labels, scores, threshold, grid, rules, radar, turned)
    out = codes.new_empty(len(rows), sum(WIDTHS))
    if len(rows) > 0:
        keys, measured = (x.contiguous() for x in radar) if radar is not None else (rows, codes)
        with torch.cuda.device_of(out):
            _decode[(triton.cdiv(len(rows), BOXES),)](
                *(codes.contiguous(), rows.contiguous(), indices.contiguous(), labels.contiguous()),
                *(scores.contiguous(), constant(rules, torch.int64, labels.device), keys, measured, out),
                *(len(rows), codes.shape[1], len(rules[0]), len(keys), len(keys).bit_length(), grid.rows, grid.cols),
                *(grid.x_min_m, grid.y_min_m, grid.cell_m, threshold, BIN_MPS, MIN_SPEED_MPS, LOG_SIZE_LIMIT),
                *(ATTRIBUTE_MOVING_MPS, OVERHEAD_M, DRIVING_MPS, LEAST_COSINE, math.sqrt(0.5)),
                MEASURED=radar is not None,
                TURNED=turned,
                BINS=NUM_BINS,
                NEAR=NEAR_BINS,
                WIDTH=sum(WIDTHS),
                BLOCK=BOXES,
                num_warps=1,
            )
        torch.atan2(codes[:, 7], codes[:, 6], out=out[:, YAW])
    return out


@triton.jit(do_not_specialize=["num", "width", "classes", "keys_num", "steps", "grid_rows", "grid_cols"])
def _decode(  # noqa: ANN202
    codes, rows, indices, labels, scores, rules, keys, measured, out,  # noqa: ANN001
    num, width, classes, keys_num, steps, grid_rows, grid_cols,  # noqa: ANN001
    x_min, y_min, cell_m, threshold, bin_mps, min_speed, size_limit,  # noqa: ANN001
    moving, overhead, driving, least_cosine, most_off,  # noqa: ANN001
    MEASURED: tl.constexpr, TURNED: tl.constexpr,
    BINS: tl.constexpr, NEAR: tl.constexpr, WIDTH: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """All but the yaws of a block of boxes."""
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = place < num
    cell = indices + 3 * tl.load(rows + place, mask=live, other=0)
    sample = tl.load(cell, mask=live, other=0)
    row = tl.load(cell + 1, mask=live, other=0)
    col = tl.load(cell + 2, mask=live, other=0)
    code, box = codes + place * width, out + place * WIDTH
    speed_x = tl.load(code + 8, mask=live, other=0.0)
    speed_y = tl.load(code + 9, mask=live, other=0.0)
    if MEASURED:
        linear = (sample * grid_rows + row) * grid_cols + col
        x = x_min + (col.to(tl.float32) + 0.5) * cell_m
        y = y_min + (row.to(tl.float32) + 0.5) * cell_m
        length = tl.maximum(tl.sqrt(x * x + y * y), 1e-12)
        x, y = x / length, y / length
        change_x, change_y = nearest_radial(
            speed_x, speed_y, linear, x, y, live, keys, measured, keys_num, steps, bin_mps, min_speed, BINS, NEAR, BLOCK
        )
        speed_x, speed_y = speed_x + change_x, speed_y + change_y
        if TURNED:
            ahead_x = tl.load(code + 6, mask=live, other=0.0)
            ahead_y = tl.load(code + 7, mask=live, other=0.0)
            length = tl.maximum(tl.sqrt(ahead_x * ahead_x + ahead_y * ahead_y), 1e-12)
            ahead_x, ahead_y = ahead_x / length, ahead_y / length
            along = speed_x * ahead_x + speed_y * ahead_y
            radial = speed_x * x + speed_y * y
            cosine = ahead_x * x + ahead_y * y
            facing = tl.abs(cosine) > least_cosine
            speed = tl.where(facing, radial / tl.where(facing, cosine, 1.0), along)
            stated = tl.sqrt(speed_x * speed_x + speed_y * speed_y)
            drives = (stated > driving) & (tl.abs(along) > most_off * stated)
            speed_x = tl.where(drives, speed * ahead_x, speed_x)
            speed_y = tl.where(drives, speed * ahead_y, speed_y)
    center_x = (col.to(tl.float32) + tl.load(code, mask=live, other=0.0)) * cell_m + x_min
    center_y = (row.to(tl.float32) + tl.load(code + 1, mask=live, other=0.0)) * cell_m + y_min
    center_z = tl.load(code + 2, mask=live, other=0.0)
    tl.store(box, center_x, mask=live)
    tl.store(box + 1, center_y, mask=live)
    tl.store(box + 2, center_z, mask=live)
    height = tl.zeros((BLOCK,), tl.float32)
    for axis in tl.static_range(3):  # the last is the height
        size = tl.load(code + 3 + axis, mask=live, other=0.0)
        size = tl.maximum(size, -size_limit, propagate_nan=tl.PropagateNan.ALL)
        height = tl.exp(tl.minimum(size, size_limit, propagate_nan=tl.PropagateNan.ALL))
        tl.store(box + 3 + axis, height, mask=live)
    tl.store(box + 7, speed_x, mask=live)
    tl.store(box + 8, speed_y, mask=live)
    score = tl.load(scores + place, mask=live, other=0.0)
    label = tl.load(labels + place, mask=live, other=0)
    rule = (tl.sqrt(speed_x * speed_x + speed_y * speed_y) > moving).to(tl.int64)
    rule += 2 * (center_z - 0.5 * height > overhead).to(tl.int64)
    tl.store(box + 9, score, mask=live)
    tl.store(box + 10, label.to(tl.float32), mask=live)
    tl.store(box + 11, tl.load(rules + rule * classes + label, mask=live, other=0).to(tl.float32), mask=live)
    tl.store(box + 12, (score > threshold).to(tl.float32), mask=live)
