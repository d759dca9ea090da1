"""The radial part of velocities as the radar measures it, around every cell (method 1.4)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import torch
import torch.nn.functional as F
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.geometry.constants import constant, where_else
from src.ops.fixed_shapes import fixed_shapes
from src.ops.moved_keys import NONE
from src.ops.radial_change import NUM_BINS, radial_bin, radial_change
from src.ops.segment_reduce import gather_segment_sum, group_sum

WINDOW_CELLS = 2
"""A cell knows the points of its 5x5 neighbourhood; their weight falls off linearly along both axes."""
MOVING_MPS = 1.0
"""What is slower does not drive (CRT-Fusion's least speed)."""
LEAST_COSINE = 0.3
"""Between heading and line of sight; at a wider angle the radial part says too little of the speed."""
REACH = tuple(range(-WINDOW_CELLS, WINDOW_CELLS + 1))
FALLOFF = tuple(WINDOW_CELLS + 1 - abs(offset) for offset in REACH)


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
    in_losses: bool = True  # see `DopplerConfig`
    along_heading: bool = False  # see `DopplerConfig`

    @classmethod
    @torch.no_grad()
    def measure(
        cls,
        radar_points: Tensor,  # [P, 7] x, y, z (m, aug frame), rcs (dB), vx, vy (m/s), dt (s)
        radar_batch: Tensor,  # [P] int64
        grid: BEVGrid,
        in_losses: bool = True,
        along_heading: bool = False,
    ) -> Self:
        """Of all points inside the grid."""
        fixed = fixed_shapes()
        xy, velocities = radar_points[:, :2].float(), radar_points[:, 4:6].float()
        approach = (velocities * xy).sum(dim=1).sign()
        bins = radial_bin(approach * velocities.norm(dim=1))
        reach = constant(REACH, torch.int64, xy.device)
        falloff = constant(tuple(float(a * b) for a in FALLOFF for b in FALLOFF), xy.dtype, xy.device)  # [25]
        row, col = (places[:, None] + reach for places in grid.cell_of(xy).unbind(1))  # [P, 5] each
        in_row, in_col = row == row.clamp(0, grid.rows - 1), col == col.clamp(0, grid.cols - 1)
        within = in_row[:, :, None] & in_col[:, None] & grid.contains(xy)[:, None, None]  # [P, 5, 5]
        linear = ((radar_batch[:, None] * grid.rows + row) * grid.cols)[:, :, None] + col[:, None]
        given = (linear * NUM_BINS + bins[:, None, None]).flatten()  # [25 P]
        values = F.pad(velocities, (1, 0), value=1.0)  # [P, 3]
        weighted = (values[:, None] * falloff[:, None]).flatten(0, 1)
        if fixed is not None:
            given = where_else(within.flatten(), given, NONE)
            keys, _, groups = fixed.grouped(given, NONE, len(given))
            sums = group_sum(weighted, groups)
            return cls(grid, keys, sums[:, 1:] / sums[:, :1].clamp(min=1.0), in_losses, along_heading)
        chosen = within.flatten().nonzero().squeeze(1)
        keys, order = torch.sort(given.index_select(0, chosen), stable=True)
        keys, counts = torch.unique_consecutive(keys, return_counts=True)
        sums = gather_segment_sum(weighted, chosen.index_select(0, order), F.pad(counts.cumsum(0), (1, 0)))
        return cls(grid, keys, sums[:, 1:] / sums[:, :1], in_losses, along_heading)

    def impose(
        self,
        velocities: Tensor,  # [n, 2] m/s over ground, augmented axes
        cells: Tensor,  # [n] int64 linear keys (b * rows + row) * cols + col, or [B, n / B, 2] positions in metres
    ) -> Tensor:  # [n, 2]
        """The velocities with the measured radial part that is nearest to theirs; as they are where none is near.

        The gradient passes as if nothing had been replaced, so that the radial part is learnt as far as it leads to a
        wrong measurement or to none; whole, where losses see the velocities of before (`in_losses` false).
        """
        given = (velocities, cells, self.keys, self.velocities, self.grid)
        return velocities + radial_change(*given) if torch.is_grad_enabled() else radial_change(*given, added=True)


def along_heading(
    velocities: Tensor,  # [n, 2] m/s over ground
    headings: Tensor,  # [n, 2] cosine and sine of the yaw, of any length
    positions: Tensor,  # [n, 2] m from the ego's origin, same axes
) -> Tensor:  # [n, 2] m/s
    """Velocities of what drives, turned into its heading: they keep their radial part, or the part along the heading.

    The latter where heading and line of sight are nearly at right angles. What is slow stays as it is, and what moves
    more than 45 degrees away from its heading, where one of both is wrong.
    """
    heading, sight = F.normalize(headings, dim=1), F.normalize(positions, dim=1)
    along, radial, cosine = ((a * b).sum(1) for a, b in ((velocities, heading), (velocities, sight), (heading, sight)))
    speed = torch.where(cosine.abs() > LEAST_COSINE, radial / cosine, along)
    stated = velocities.norm(dim=1)
    drives = (stated > MOVING_MPS) & (along.abs() > math.sqrt(0.5) * stated)
    return torch.where(drives[:, None], speed[:, None] * heading, velocities)
