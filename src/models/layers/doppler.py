"""The radial part of velocities as the radar measures it, around every cell (method 1.4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch
import torch.nn.functional as F
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.geometry.constants import constant
from src.ops.segment_reduce import segment_sum
from src.ops.sites import rows_of_keys

WINDOW_CELLS = 2
"""A cell knows the points of its 5x5 neighbourhood; their weight falls off linearly along both axes."""
BIN_MPS = 6.0
NUM_BINS = 31
"""Bins of radial speed, which keep a mover, what stands beside it and an aliased value apart."""
NEAR_BINS = 2
"""How far a prediction may be from the measured value it takes: 12 to 18 m/s, less than an aliased value is off."""
MIN_SPEED_MPS = 0.5
"""Below it a velocity is noise whose direction says nothing; the line of sight is then that from the ego's origin."""


@dataclass(kw_only=True)
class DopplerConfig:
    """Whose predicted velocities take their radial part from the radar, where it measures a near one (`model.doppler`).

    A part that a phase or a model lacks is not asked.
    """

    gaussians: bool
    cells: bool
    boxes: bool


@dataclass
class Doppler:
    """Mean velocities of the points around each cell, one for every bin of radial speed that has a point.

    A point's velocity is the radial part alone, compensated for the ego motion.
    """

    grid: BEVGrid
    keys: Tensor  # [n] int64 ((b * rows + row) * cols + col) * NUM_BINS + bin, sorted, unique
    velocities: Tensor  # [n, 2] m/s over ground, augmented axes

    @classmethod
    @torch.no_grad()
    def measure(
        cls,
        radar_points: Tensor,  # [P, 7] x, y, z (m, aug frame), rcs (dB), vx, vy (m/s), dt (s)
        radar_batch: Tensor,  # [P] int64
        grid: BEVGrid,
    ) -> Self:
        """Of all points inside the grid."""
        inside = grid.contains(radar_points[:, :2]).nonzero().squeeze(1)
        xy, velocities = radar_points[inside, :2].float(), radar_points[inside, 4:6].float()
        approach = (velocities * xy).sum(dim=1).sign()
        bins = _bin_of(approach * velocities.norm(dim=1))
        reach = torch.arange(-WINDOW_CELLS, WINDOW_CELLS + 1, device=xy.device)
        offsets = torch.cartesian_prod(reach, reach)  # [25, 2] (row, col)
        weights = (WINDOW_CELLS + 1 - offsets.abs()).prod(dim=1).to(xy.dtype)
        cells = grid.cell_of(xy)[:, None] + offsets  # [P, 25, 2]
        limit = constant(tuple(grid.cells), torch.int64, xy.device)
        point, offset = ((cells >= 0) & (cells < limit)).all(dim=2).nonzero().unbind(1)
        row, col = cells[point, offset].unbind(1)
        linear = (radar_batch[inside][point] * grid.rows + row) * grid.cols + col
        keys, owners = torch.unique(linear * NUM_BINS + bins[point], return_inverse=True)
        weight = weights[offset][:, None]
        sums = segment_sum(torch.cat([weight, weight * velocities[point]], dim=1), owners, len(keys))
        return cls(grid, keys, sums[:, 1:] / sums[:, :1])

    def impose(
        self,
        velocities: Tensor,  # [n, 2] m/s over ground, augmented axes
        cells: Tensor,  # [n] int64 linear keys (b * rows + row) * cols + col
    ) -> Tensor:  # [n, 2]
        """The velocities with the measured radial part that is nearest to theirs; as they are where none is near.

        Near is within NEAR_BINS of the own bin of radial speed. The gradient passes as if nothing had been replaced,
        so that the radial part is learnt as far as it leads to a wrong measurement or to none.
        """
        with torch.no_grad():
            row, col = torch.div(cells, self.grid.cols, rounding_mode="floor") % self.grid.rows, cells % self.grid.cols
            sight = F.normalize(self.grid.centre_of(torch.stack([row, col], dim=1)), dim=1)
            near = torch.arange(-NEAR_BINS, NEAR_BINS + 1, device=cells.device)
            bins = _bin_of((velocities * sight).sum(dim=1))[:, None] + near
            rows = rows_of_keys(self.keys, cells[:, None] * NUM_BINS + bins.clamp(0, NUM_BINS - 1))  # [n, 5]
            measured = F.embedding(rows.where(rows >= 0, len(self.keys)), F.pad(self.velocities, (0, 0, 0, 1)))
            miss = ((measured - velocities[:, None]) * sight[:, None]).sum(dim=2).abs()
            best = miss.where(rows >= 0, torch.inf).argmin(dim=1, keepdim=True)  # [n, 1]
            measured = measured.gather(1, best[..., None].expand(-1, -1, 2)).squeeze(1)
            moving = measured.norm(dim=1, keepdim=True) > MIN_SPEED_MPS
            direction = F.normalize(torch.where(moving, measured, sight), dim=1)
            change = ((measured - velocities) * direction).sum(dim=1, keepdim=True) * direction
            change = change * (rows.gather(1, best) >= 0)
        return velocities + change


def _bin_of(radial_mps: Tensor) -> Tensor:
    """Of signed radial speeds, positive for what moves away."""
    half = NUM_BINS // 2
    return (radial_mps / BIN_MPS).round().clamp(-half, half).long() + half
