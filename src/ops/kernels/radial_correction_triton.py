"""Votes of radar points, and the nearest measured radial velocity, by a Triton launch each."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.ops.backend import runs_kernels
from src.ops.kernels.sorted_search_triton import lower_bound
from src.ops.moved_keys import NONE
from src.ops.radial_correction import (
    BIN_MPS,
    MIN_SPEED_MPS,
    NEAR_BINS,
    NUM_BINS,
    WINDOW_CELLS,
    radial_correction_reference,
    radial_votes_reference,
)

VELOCITIES = 128
"""Velocities or votes of a program, one lane each."""


def radial_votes_triton(points: Tensor, batch: Tensor, grid: BEVGrid) -> tuple[Tensor, Tensor]:
    """The reference's votes; a speed between two bins may go to the other, as it is rounded."""
    if points.dtype != torch.float32 or not runs_kernels(points):
        return radial_votes_reference(points, batch, grid)
    num = len(points) * (2 * WINDOW_CELLS + 1) ** 2
    keys, weighted = batch.new_empty(num), points.new_empty(num, 3)
    if num > 0:
        with torch.cuda.device_of(points):
            _vote[(triton.cdiv(num, VELOCITIES),)](
                *(points.contiguous(), batch.contiguous(), keys, weighted, num, points.shape[1]),
                *(grid.rows, grid.cols, grid.x_min_m, grid.y_min_m, grid.cell_m, BIN_MPS),
                BINS=NUM_BINS,
                WINDOW=WINDOW_CELLS,
                OUTSIDE=NONE,
                BLOCK=VELOCITIES,
                num_warps=4,
            )
    return keys, weighted


def radial_correction_triton(
    velocities: Tensor, cells: Tensor, keys: Tensor, measured: Tensor, grid: BEVGrid, added: bool = False
) -> Tensor:
    """The reference's change up to rounding."""
    placed = cells.dim() == 3
    if velocities.dtype != torch.float32 or (placed and cells.dtype != torch.float32) or not runs_kernels(velocities):
        return radial_correction_reference(velocities, cells, keys, measured, grid, added)
    velocities, out = velocities.contiguous(), velocities.new_empty(velocities.shape)
    if len(out) > 0:
        with torch.cuda.device_of(out):
            _nearest_radial[(triton.cdiv(len(out), VELOCITIES),)](
                *(velocities, cells.contiguous(), keys.contiguous(), measured.contiguous(), out),
                *(len(out), len(keys), len(keys).bit_length(), grid.rows, grid.cols),
                *(grid.x_min_m, grid.y_min_m, grid.cell_m, BIN_MPS, MIN_SPEED_MPS),
                *(cells.shape[1] if placed else 1, placed, added),
                BINS=NUM_BINS,
                NEAR=NEAR_BINS,
                BLOCK=VELOCITIES,
                num_warps=4,
            )
    return out


@triton.jit
def _radial_bin(radial, BINS: tl.constexpr):  # noqa: ANN001, ANN202
    """The bin of each radial speed, which is in bins."""
    bin_ = tl.floor(radial + 0.5)
    odd = bin_ - 2.0 * tl.floor(0.5 * bin_)
    bin_ = tl.where((bin_ - radial == 0.5) & (odd == 1.0), bin_ - 1.0, bin_)  # halves go to the even one, as torch's do
    half = BINS // 2
    return tl.minimum(tl.maximum(bin_, -half), half).to(tl.int64) + half


@triton.jit(do_not_specialize=["num", "width", "rows", "cols"])
def _vote(  # noqa: ANN202
    points, batch, keys, weighted, num, width, rows, cols, x_min, y_min, cell_m, bin_mps,  # noqa: ANN001
    BINS: tl.constexpr, WINDOW: tl.constexpr, OUTSIDE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """A block of votes, those of a point one after the other."""
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = place < num
    edge = 2 * WINDOW + 1
    point, own = place // (edge * edge), place % (edge * edge)
    down, right = own // edge - WINDOW, own % edge - WINDOW
    start = points + point * width
    x, y = tl.load(start, mask=live, other=0.0), tl.load(start + 1, mask=live, other=0.0)
    speed_x, speed_y = tl.load(start + 4, mask=live, other=0.0), tl.load(start + 5, mask=live, other=0.0)
    away = speed_x * x + speed_y * y
    speed = tl.sqrt(speed_x * speed_x + speed_y * speed_y)
    bin_ = _radial_bin(tl.where(away > 0.0, speed, tl.where(away < 0.0, -speed, 0.0)) / bin_mps, BINS)
    col, row = tl.floor(tl.div_rn(x - x_min, cell_m)), tl.floor(tl.div_rn(y - y_min, cell_m))
    within = (col >= 0.0) & (col < cols) & (row >= 0.0) & (row < rows)  # a point that is not finite is nowhere
    col = tl.where(within, col, 0.0).to(tl.int64) + right
    row = tl.where(within, row, 0.0).to(tl.int64) + down
    within = within & (col >= 0) & (col < cols) & (row >= 0) & (row < rows)
    linear = (tl.load(batch + point, mask=live, other=0) * rows + row) * cols + col
    tl.store(keys + place, tl.where(within, linear * BINS + bin_, OUTSIDE), mask=live)
    weight = ((WINDOW + 1 - tl.abs(down)) * (WINDOW + 1 - tl.abs(right))).to(tl.float32)
    tl.store(weighted + 3 * place, weight, mask=live)
    tl.store(weighted + 3 * place + 1, speed_x * weight, mask=live)
    tl.store(weighted + 3 * place + 2, speed_y * weight, mask=live)


@triton.jit
def nearest_radial(  # noqa: ANN201
    own_x, own_y, cell, x, y, live, keys, measured, keys_num, steps, bin_mps, min_speed,  # noqa: ANN001
    BINS: tl.constexpr, NEAR: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """What BLOCK velocities change by, seen along (x, y) from the origin; the first of equally near ones counts."""
    bin_ = _radial_bin((own_x * x + own_y * y) / bin_mps, BINS)
    least = tl.full((BLOCK,), float("inf"), tl.float32)
    found_x = tl.zeros((BLOCK,), tl.float32)
    found_y = tl.zeros((BLOCK,), tl.float32)
    for away in range(-NEAR, NEAR + 1):
        wanted = cell * BINS + tl.minimum(tl.maximum(bin_ + away, 0), BINS - 1)
        low = lower_bound(keys, wanted, keys_num, steps, BLOCK)
        inside = live & (low < keys_num)
        hit = inside & (tl.load(keys + low, mask=inside, other=0) == wanted)
        new_x = tl.load(measured + 2 * low, mask=hit, other=0.0)
        new_y = tl.load(measured + 2 * low + 1, mask=hit, other=0.0)
        miss = tl.abs((new_x - own_x) * x + (new_y - own_y) * y)
        nearer = hit & (miss < least)
        least = tl.where(nearer, miss, least)
        found_x = tl.where(nearer, new_x, found_x)
        found_y = tl.where(nearer, new_y, found_y)
    speed = tl.sqrt(found_x * found_x + found_y * found_y)
    moving = speed > min_speed
    safe = tl.maximum(speed, 1e-12)
    x, y = tl.where(moving, found_x / safe, x), tl.where(moving, found_y / safe, y)
    change = tl.where(least < float("inf"), (found_x - own_x) * x + (found_y - own_y) * y, 0.0)
    return change * x, change * y


@triton.jit(do_not_specialize=["num", "keys_num", "steps", "rows", "cols", "per_sample"])
def _nearest_radial(  # noqa: ANN202
    velocities, cells, keys, measured, out, num, keys_num, steps, rows, cols,  # noqa: ANN001
    x_min, y_min, cell_m, bin_mps, min_speed, per_sample,  # noqa: ANN001
    PLACED: tl.constexpr, ADDED: tl.constexpr,
    BINS: tl.constexpr, NEAR: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """All near bins of a block of velocities."""
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = place < num
    if PLACED:
        col = tl.floor(tl.div_rn(tl.load(cells + 2 * place, mask=live, other=0.0) - x_min, cell_m)).to(tl.int64)
        row = tl.floor(tl.div_rn(tl.load(cells + 2 * place + 1, mask=live, other=0.0) - y_min, cell_m)).to(tl.int64)
        cell = (place // per_sample * rows + row) * cols + col
    else:
        cell = tl.load(cells + place, mask=live, other=0)
        col, row = cell % cols, cell // cols % rows
    x = x_min + (col.to(tl.float32) + 0.5) * cell_m
    y = y_min + (row.to(tl.float32) + 0.5) * cell_m
    length = tl.maximum(tl.sqrt(x * x + y * y), 1e-12)
    x, y = x / length, y / length
    own_x = tl.load(velocities + 2 * place, mask=live, other=0.0)
    own_y = tl.load(velocities + 2 * place + 1, mask=live, other=0.0)
    new_x, new_y = nearest_radial(
        own_x, own_y, cell, x, y, live, keys, measured, keys_num, steps, bin_mps, min_speed, BINS, NEAR, BLOCK
    )
    if ADDED:
        new_x, new_y = own_x + new_x, own_y + new_y
    tl.store(out + 2 * place, new_x, mask=live)
    tl.store(out + 2 * place + 1, new_y, mask=live)
