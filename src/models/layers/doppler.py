"""The radial part of velocities as the radar measures it, around every cell (method 1.4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch
import torch.nn.functional as F
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.ops.fixed_shapes import fixed_shapes
from src.ops.moved_keys import NONE
from src.ops.radial_correction import radial_correction, radial_votes
from src.ops.segment_reduce import gather_segment_sum, group_sum


@dataclass(kw_only=True)
class DopplerConfig:
    """Whose predicted velocities take their radial part from the radar, where it measures a near one (`model.doppler`).

    A part that a phase or a model lacks is not asked.
    """

    gaussians: bool
    cells: bool
    boxes: bool
    in_losses: bool  # losses see these velocities; else those that the network regresses
    along_heading: bool  # a box that moves does so along its heading, with that radial part


@dataclass
class Doppler:
    """Mean velocities of the points around each cell, one for every bin of radial speed that has a point.

    A point's velocity is the radial part alone, compensated for the ego motion.
    """

    grid: BEVGrid
    keys: Tensor  # [n] int64 ((b * rows + row) * cols + col) * NUM_BINS + bin, sorted, unique; padding has the largest
    velocities: Tensor  # [n, 2] m/s over ground, augmented axes
    config: DopplerConfig

    @classmethod
    @torch.no_grad()
    def measure(
        cls,
        radar_points: Tensor,  # [P, 7] x, y, z (m, aug frame), rcs (dB), vx, vy (m/s), dt (s)
        radar_batch: Tensor,  # [P] int64
        grid: BEVGrid,
        config: DopplerConfig,
    ) -> Self:
        """Average the velocities of the points inside the grid around each cell, by radial speed."""
        given, weighted = radial_votes(radar_points, radar_batch, grid)
        if (fixed := fixed_shapes()) is not None:
            keys, _, groups = fixed.grouped(given, NONE, len(given))
            sums = group_sum(weighted, groups)
            return cls(grid, keys, sums[:, 1:] / sums[:, :1].clamp(min=1.0), config)
        chosen = (given < NONE).nonzero().squeeze(1)
        keys, order = torch.sort(given.index_select(0, chosen), stable=True)
        keys, counts = torch.unique_consecutive(keys, return_counts=True)
        sums = gather_segment_sum(weighted, chosen.index_select(0, order), F.pad(counts.cumsum(0), (1, 0)))
        return cls(grid, keys, sums[:, 1:] / sums[:, :1], config)

    def correct(
        self,
        velocities: Tensor,  # [n, 2] m/s over ground, augmented axes
        cells: Tensor,  # [n] int64 linear keys (b * rows + row) * cols + col, or [B, n / B, 2] positions in metres
    ) -> Tensor:  # [n, 2]
        """The velocities with the measured radial part that is nearest to theirs; as they are where none is near.

        The gradient passes as if nothing had been replaced, so that the radial part is learnt as far as it leads to a
        wrong measurement or to none; whole, where losses see the velocities of before (`in_losses` false).
        """
        given = (velocities, cells, self.keys, self.velocities, self.grid)
        if torch.is_grad_enabled():
            return velocities + radial_correction(*given)
        return radial_correction(*given, added=True)
