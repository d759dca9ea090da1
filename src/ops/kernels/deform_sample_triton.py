"""Deformable attention to the cells of a sparse map in one Triton launch and to the images of all views in one for each
level: a program a query (method 5.2 and 5.3)."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.ops.backend import runs_kernels
from src.ops.deform_sample import attend_cells_reference, attend_views_reference


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


def attend_views_triton(
    images: list[Tensor],  # per level [B * N, heads * c, H_l, W_l]
    places: Tensor,  # [B * N, Q, P, 2] in -1..1 of the image
    weights: Tensor,  # [B, Q, heads, N, L, P]
) -> Tensor:  # [B, Q, heads * c]
    """The reference's sums in float32."""
    if any(x.dtype != torch.float32 for x in (*images, places, weights)) or not runs_kernels(places):
        return attend_views_reference(images, places, weights)
    batch_size, queries, heads, views, levels, points = weights.shape
    channels = images[0].shape[1]
    out = places.new_empty(batch_size, queries, channels)
    if out.numel() > 0:
        places, weights = places.contiguous(), weights.contiguous()
        with torch.cuda.device_of(out):
            for level, image in enumerate(images):
                _attend_level[(batch_size * queries,)](
                    *(image, places, weights, out, level, levels),
                    *(queries, views, points, heads, channels, image.shape[2], image.shape[3], *image.stride()),
                    BLOCK=triton.next_power_of_2(channels),
                    num_warps=1,
                )
    return out


@triton.jit(do_not_specialize=["level", "levels", "queries", "views", "points", "heads", "height", "width"])
def _attend_level(  # noqa: ANN202
    image, places, weights, out, level, levels,  # noqa: ANN001
    queries, views, points, heads, channels, height, width,  # noqa: ANN001
    stride_image, stride_channel, stride_row, stride_col,  # noqa: ANN001
    BLOCK: tl.constexpr,
):  # fmt: skip
    """What one query gathers from one level of all views, added to what it has."""
    query = tl.program_id(0).to(tl.int64)  # of all samples
    sample, own = query // queries, query % queries
    channel = tl.arange(0, BLOCK)
    wide = channel < channels
    head = channel // (channels // heads)
    total = tl.load(out + query * channels + channel, mask=wide & (level > 0), other=0.0)
    for view in range(0, views):
        picture = image + (sample * views + view) * stride_image + channel * stride_channel
        corner = places + ((sample * views + view) * queries + own) * points * 2
        own_weights = weights + (((query * heads + head) * views + view) * levels + level) * points
        for point in range(0, points):
            x = ((tl.load(corner + 2 * point) + 1.0) * width - 1.0) * 0.5
            y = ((tl.load(corner + 2 * point + 1) + 1.0) * height - 1.0) * 0.5
            if (x > -1.0) & (x < width) & (y > -1.0) & (y < height):
                low_x, low_y = tl.floor(x), tl.floor(y)
                share = tl.load(own_weights + point, mask=wide, other=0.0)
                for step in tl.static_range(4):
                    col, row = low_x + step % 2, low_y + step // 2
                    inside = (col >= 0) & (col < width) & (row >= 0) & (row < height)
                    pixel = tl.where(inside, row.to(tl.int64) * stride_row + col.to(tl.int64) * stride_col, -1)
                    found = tl.load(picture + pixel, mask=wide & (pixel >= 0), other=0.0)
                    total += share * ((1.0 - tl.abs(x - col)) * (1.0 - tl.abs(y - row))) * found
    tl.store(out + query * channels + channel, total, mask=wide)
