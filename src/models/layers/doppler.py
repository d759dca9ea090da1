"""The radial part of velocities as the radar measures it, around every cell (method 1.4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch
import torch.nn.functional as F
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.ops.segment_reduce import segment_sum

PASSES = 2
"""Sums over 3x3 cells one after the other: a window of 5x5 cells whose weight falls off with distance."""
MIN_SPEED_MPS = 0.5
"""Below it a velocity is noise whose direction says nothing; the line of sight is then that from the ego's origin."""


@dataclass(kw_only=True)
class DopplerConfig:
    """Whose predicted velocities take their radial part from the radar, wherever a point is near (`model.doppler`)."""

    gaussians: bool
    cells: bool
    boxes: bool


@dataclass
class Doppler:
    """Mean velocity of the points around each cell, weighted by speed, so that one moving point among standing ones
    decides. A point's velocity is the radial part alone, compensated for the ego motion."""

    grid: BEVGrid
    velocities: Tensor  # [B * rows * cols, 2] m/s over ground, augmented axes
    seen: Tensor  # [B * rows * cols] bool, a point is near

    @classmethod
    @torch.no_grad()
    def measure(
        cls,
        radar_points: Tensor,  # [P, 7] x, y, z (m, aug frame), rcs (dB), vx, vy (m/s), dt (s)
        radar_batch: Tensor,  # [P] int64
        batch_size: int,
        grid: BEVGrid,
    ) -> Self:
        """Of all points inside the grid."""
        points = radar_points.float()
        inside = grid.contains(points[:, :2]).nonzero().squeeze(1)
        row, col = grid.cell_of(points[inside, :2]).unbind(1)
        velocities = points[inside, 4:6]
        speeds = velocities.norm(dim=1, keepdim=True)
        values = torch.cat([torch.ones_like(speeds), speeds, speeds * velocities], dim=1)
        linear = (radar_batch[inside] * grid.rows + row) * grid.cols + col
        sums = segment_sum(values, linear, batch_size * grid.rows * grid.cols)  # [B * rows * cols, 4]
        sums = sums.view(batch_size, grid.rows, grid.cols, 4).permute(0, 3, 1, 2)
        with torch.autocast(sums.device.type, enabled=False):
            for _ in range(PASSES):
                sums = F.avg_pool2d(sums, 3, stride=1, padding=1, divisor_override=1)
        counts, speeds, products = sums.permute(0, 2, 3, 1).flatten(0, 2).split([1, 1, 2], dim=1)
        return cls(grid, products / speeds.clamp(min=1e-6), counts.squeeze(1) > 0)

    def impose(
        self,
        velocities: Tensor,  # [n, 2] m/s over ground, augmented axes
        cells: Tensor,  # [n] int64 linear keys (b * rows + row) * cols + col
    ) -> Tensor:  # [n, 2]
        """The velocities with the measured radial part where a point is near; no gradient reaches what it replaces."""
        row, col = torch.div(cells, self.grid.cols, rounding_mode="floor") % self.grid.rows, cells % self.grid.cols
        measured, seen = self.velocities[cells], self.seen[cells]
        line_of_sight = self.grid.centre_of(torch.stack([row, col], dim=1))
        moving = measured.norm(dim=1, keepdim=True) > MIN_SPEED_MPS
        direction = F.normalize(torch.where(moving, measured, line_of_sight), dim=1)
        change = ((measured - velocities) * direction).sum(dim=1, keepdim=True)
        return velocities + seen[:, None] * change * direction
