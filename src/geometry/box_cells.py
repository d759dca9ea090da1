"""Cells under rotated boxes, and in the windows that rasters and splats test cell by cell."""

from __future__ import annotations

import torch
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.geometry.constants import arange, constant
from src.geometry.ragged import enumerate_windows
from src.geometry.tensor_transforms import rotate_back

# Closed rectangles: a cell centre on the edge counts, whatever the rounding of its coordinates says.
EDGE_TOLERANCE_M = 1e-6


def window_cells(
    centres: Tensor,  # [n, 2] (x, y) in cells; cell (row, col) has its centre at (col, row)
    half_extents: Tensor,  # [n, 2] (x, y) in cells, not negative
    grid: BEVGrid,
) -> tuple[Tensor, Tensor, Tensor]:  # [pairs] int64 each
    """Every cell of the grid whose centre lies in an axis-aligned window, for all windows at once.

    Returns (window, row, col), ordered by window and row-major within. Windows outside the grid and NaN windows have no
    cells that any sensible test would keep.
    """
    return enumerate_windows(*window_corners(centres, half_extents, grid))


def window_corners(
    centres: Tensor,  # [n, 2] (x, y) in cells
    half_extents: Tensor,  # [n, 2] (x, y) in cells, not negative
    grid: BEVGrid,
) -> tuple[Tensor, Tensor]:  # [n, 2] int64 (col, row) each
    """First and last cell of the windows of `window_cells`."""
    limit = constant((grid.cols, grid.rows), torch.int64, centres.device)
    low = torch.maximum((centres - half_extents).ceil(), torch.zeros_like(centres)).minimum(limit).long()  # [n, 2]
    high = torch.maximum((centres + half_extents).floor(), -torch.ones_like(centres)).minimum(limit - 1).long()
    return low, high


def cells_in_boxes(
    boxes: Tensor,  # [n, 5] (x, y, length, width, yaw): metres, radians, frame of the grid
    grid: BEVGrid,
    margin_m: float = 0.0,
) -> tuple[Tensor, Tensor, Tensor]:
    """Cells whose centres the boxes cover, with length and width enlarged by `margin_m` in total (method 8.2).

    The rectangle is closed and each of its dimensions at least one cell. A box that covers no centre gets the one cell
    that contains its own centre, if the grid has it. Returns (box, cell) [pairs] int64 sorted by box and cell, with
    cell = row * cols + col, and `fallback` [n] bool: the boxes of the last rule. Computed in float64.
    """
    if boxes.dim() != 2 or boxes.shape[1] != 5:
        raise ValueError(f"boxes: expected [n, 5] (x, y, length, width, yaw), got {list(boxes.shape)}")
    boxes = boxes.detach().double()
    cosine, sine = boxes[:, 4].cos(), boxes[:, 4].sin()
    half = 0.5 * (boxes[:, 2:4] + margin_m).clamp(min=grid.cell_m) + EDGE_TOLERANCE_M  # [n, 2] m
    reach = torch.stack(
        [half[:, 0] * cosine.abs() + half[:, 1] * sine.abs(), half[:, 0] * sine.abs() + half[:, 1] * cosine.abs()], 1
    )
    centres = grid.to_cells(boxes[:, :2]) - 0.5
    box, row, col = window_cells(centres, reach / grid.cell_m, grid)
    offset = (torch.stack([col, row], 1) - centres.index_select(0, box)) * grid.cell_m  # [pairs, 2] m
    cosine, sine, half = cosine.index_select(0, box), sine.index_select(0, box), half.index_select(0, box)
    along, across = rotate_back(cosine, sine, *offset.unbind(1))
    inside = (along.abs() <= half[:, 0]) & (across.abs() <= half[:, 1])
    bare = box.new_zeros(len(boxes)).index_add(0, box, inside.long()) == 0
    fallback = bare & grid.contains(boxes[:, :2])
    # The cells of the last rule are candidates of every box, so that one look at all decides.
    home = grid.cell_of(boxes[:, :2])
    cell = torch.cat([row * grid.cols + col, home[:, 0] * grid.cols + home[:, 1]])
    box = torch.cat([box, arange(len(boxes), torch.int64, box.device)])
    kept = torch.cat([inside, fallback]).nonzero().squeeze(1)
    box, order = torch.sort(box[kept], stable=True)
    return box, cell[kept[order]], fallback
