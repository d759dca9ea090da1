"""Radial velocities as the radar measures them, around each cell of its map."""

from __future__ import annotations

from enum import Enum

import torch
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.ops.kernel_maps import submanifold_map
from src.ops.segment_reduce import segment_sum
from src.ops.sparse_conv import neighbour_sum
from src.structures.sparse_bev import SparseBEV

PASSES = 2
"""Sums over 3x3 cells one after the other: a window of 5x5 cells whose weight falls off with distance."""
MIN_SPEED_SUM_MPS = 0.02
"""Below it nothing moves."""


class VelocityStart(Enum):
    """What a predicted velocity is added to: nothing, or what the radar has measured there."""

    zero = "zero"
    doppler = "doppler"


@torch.no_grad()
def doppler_map(
    bev: SparseBEV,
    grid: BEVGrid,
    radar_points: Tensor,  # [P, 7] x, y, z (m, aug frame), rcs (dB), vx, vy (m/s), dt (s)
    radar_batch: Tensor,  # [P] int64
) -> SparseBEV:  # [M, 2] m/s over ground, augmented axes
    """Mean velocity of the points around each cell of the map, weighted by speed; zero where no point is near.

    A point's velocity is its radial part, compensated for the ego motion: what crosses the line of sight is missing.
    The weight lets one moving point decide among standing ones.
    """
    velocities = radar_points[:, 4:6].float()
    speeds = velocities.norm(dim=1, keepdim=True)
    cells = torch.cat([radar_batch[:, None], grid.cell_of(radar_points[:, :2])], dim=1)
    sums = window_sums(bev, cells, torch.cat([speeds, speeds * velocities], dim=1))
    return bev.with_features(sums[:, 1:] / sums[:, :1].clamp(min=MIN_SPEED_SUM_MPS))


def window_sums(
    bev: SparseBEV,
    cells: Tensor,  # [P, 3] int64 (batch, row, col) of each point
    values: Tensor,  # [P, C]
) -> Tensor:  # [M, C]
    """Weighted sum of the points' values in the window of each cell; points outside the map's cells are left out."""
    rows = bev.sites.rows_of(cells)
    near = (rows >= 0).nonzero().squeeze(1)
    sums = segment_sum(values[near], rows[near], len(bev))
    window = submanifold_map(bev.sites, 3)
    for _ in range(PASSES):
        sums = neighbour_sum(sums, window)
    return sums
