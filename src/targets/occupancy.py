"""Occupancy supervision: the cells that annotated boxes cover (method 5.6, 6.1, 8.2)."""

from __future__ import annotations

import torch
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.geometry.box_cells import cells_in_boxes
from src.structures.boxes import Boxes3D
from src.targets.supervision import supervised_boxes


def occupied_cells(
    boxes: list[Boxes3D],  # B, augmented ego frame
    grid: BEVGrid,
    margin_m: float,
) -> Tensor:  # [P] int64
    """Linear keys (b * rows + row) * cols + col of all cells in the boxes, sorted and unique.

    `margin_m` enlarges length and width in total: 0 for the tight mask, epsilon for the mask of the splatted occupancy.
    """
    joined, batch = supervised_boxes(boxes, grid)
    return torch.unique(box_cell_keys(joined, batch, grid, margin_m)[1])


def box_cell_keys(
    boxes: Boxes3D,  # K boxes of a batch
    batch: Tensor,  # [K] int64
    grid: BEVGrid,
    margin_m: float,
) -> tuple[Tensor, Tensor]:  # [pairs], [pairs] int64
    """All (box, cell) pairs, the cell as a linear key."""
    owners, cells, _ = cells_in_boxes(boxes.bev(), grid, margin_m)
    return owners, batch[owners] * (grid.rows * grid.cols) + cells
