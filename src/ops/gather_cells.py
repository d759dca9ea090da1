"""Features and centres of some cells of a sparse map, as radar keypoints need them (method 4.1)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.ops.backend import implementation


def gather_cells(
    features: Tensor,  # [M, C]
    indices: Tensor,  # [M, 3] int64 (sample, row, col)
    rows: Tensor,  # [B, K] int64, -1 for none
    grid: BEVGrid,
) -> tuple[Tensor, Tensor, Tensor]:  # [B, K, 2] m, [B, K] bool, [B, K, C]
    """Centres, whether there is a cell, and its features, zero for none; with a gradient where one is wanted."""
    form = gather_cells_reference if torch.is_grad_enabled() else implementation(gather_cells_reference)
    return form(features, indices, rows, grid)


def gather_cells_reference(
    features: Tensor, indices: Tensor, rows: Tensor, grid: BEVGrid
) -> tuple[Tensor, Tensor, Tensor]:
    """Plain torch form."""
    valid = rows >= 0
    cells = F.pad(indices, (0, 0, 1, 0))  # a row before them, which padding reads
    features = F.pad(features, (0, 0, 1, 0))
    picks = rows + 1
    return grid.centre_of(cells[picks][..., 1:]), valid, F.embedding(picks, features)
