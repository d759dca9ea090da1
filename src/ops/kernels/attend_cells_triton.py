"""Deformable attention to the cells of a sparse map in one Triton launch: a program a query (method 5.2)."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.ops.backend import runs_kernels
from src.ops.deform_sample import attend_cells_reference


def attend_cells_triton(
    values: Tensor,  # [M, heads, C / heads]
    table: Tensor,  # [B * rows * cols (+ 1)] int64
    points: Tensor,  # [Q, P, 2] m
    batch: Tensor,  # [Q] int64
    weights: Tensor,  # [Q, heads, P]
    grid: BEVGrid,
) -> Tensor:  # [Q, C]
    """The reference's sums in float32, of values in any float type."""
    if points.dtype != torch.float32 or weights.dtype != torch.float32 or not runs_kernels(points):
        return attend_cells_reference(values, table, points, batch, weights, grid)
    heads, channels = values.shape[1], values.shape[1] * values.shape[2]
    out = points.new_empty(len(points), channels)
    if out.numel() > 0:
        with torch.cuda.device_of(out):
            _attend_cells[(len(points),)](
                *(values.contiguous(), table, points.contiguous(), batch.contiguous(), weights.contiguous(), out),
                *(points.shape[1], heads, channels, grid.rows, grid.cols, grid.x_min_m, grid.y_min_m, grid.cell_m),
                BLOCK=triton.next_power_of_2(channels),
                num_warps=1,
            )
    return out


@triton.jit(do_not_specialize=["num", "heads", "rows", "cols"])
def _attend_cells(  # noqa: ANN202
    values, table, points, batch, weights, out,  # noqa: ANN001
    num, heads, channels, rows, cols, x_min, y_min, cell_m,  # noqa: ANN001
    BLOCK: tl.constexpr,
):  # fmt: skip
    """All points of one query, the four cells around each."""
    query = tl.program_id(0).to(tl.int64)
    channel = tl.arange(0, BLOCK)
    wide = channel < channels
    head = channel // (channels // heads)
    first = tl.load(batch + query) * rows * cols
    total = tl.zeros((BLOCK,), tl.float32)
    for point in range(0, num):
        corner = points + (query * num + point) * 2
        x = (tl.load(corner) - x_min) / cell_m - 0.5
        y = (tl.load(corner + 1) - y_min) / cell_m - 0.5
        # What is not a number, or far away, meets no cell.
        x = tl.where(x == x, tl.minimum(tl.maximum(x, -2.0), cols + 1.0), -2.0)
        y = tl.where(y == y, tl.minimum(tl.maximum(y, -2.0), rows + 1.0), -2.0)
        low_x, low_y = tl.floor(x), tl.floor(y)
        share = tl.load(weights + (query * heads + head) * num + point, mask=wide, other=0.0)
        for step in tl.static_range(4):
            col, row = low_x + step % 2, low_y + step // 2
            weight = (1.0 - tl.abs(x - col)) * (1.0 - tl.abs(y - row))
            inside = (col >= 0) & (col < cols) & (row >= 0) & (row < rows)
            cell = row.to(tl.int64) * cols + col.to(tl.int64)
            place = tl.load(table + first + cell, mask=inside, other=-1)
            found = tl.load(values + place * channels + channel, mask=wide & (place >= 0), other=0.0)
            total += share * weight * found.to(tl.float32)
    tl.store(out + query * channels + channel, total, mask=wide)
