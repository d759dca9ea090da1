"""Local means of the radar points as a residual of the radar map."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from src.geometry.bev_grid import BEVGrid
from src.ops.fixed_shapes import fixed_shapes
from src.ops.kernel_maps import submanifold_map
from src.ops.segment_reduce import segment_sum
from src.ops.sparse_conv import neighbour_sum
from src.structures.sparse_bev import SparseBEV

PASSES = 2
"""Sums over 3x3 cells one after the other: a window of 5x5 cells whose weight falls off with distance."""
MIN_SPEED_SUM = 1e-3
"""Below it nothing moves, in units of the velocity scale."""


class LocalMeans(nn.Module):
    """What the points around every cell measure on average, embedded and added to the cell.

    A sparse convolution sums over the neighbours that happen to exist, so the amount of, say, the velocity it carries
    grows with their number, and a network must first learn to divide by it. Here the division is done.
    """

    def __init__(
        self,
        point_scales: Tensor,  # [7] x, y, z (m), rcs (dB), vx, vy (m/s), dt (s)
        grid: BEVGrid,
        channels: int,
    ) -> None:
        super().__init__()
        self.grid = grid
        self.register_buffer("point_scales", point_scales, persistent=False)
        self.embed = nn.Linear(len(point_scales) + 3, channels)

    def forward(
        self,
        bev: SparseBEV,
        radar_points: Tensor,  # [P, 7] aug frame
        radar_batch: Tensor,  # [P] int64
    ) -> SparseBEV:
        """Add what the points measure to the map's sites; points in other cells are left out."""
        means = self.measure(bev, radar_points, radar_batch)
        return bev.with_features(bev.features + self.embed(means))

    @torch.no_grad()
    def measure(self, bev: SparseBEV, radar_points: Tensor, radar_batch: Tensor) -> Tensor:  # [M, 10] float32
        """What the points in the window of each cell measure. All 0 where no point is near.

        The mean point, its position as cells from the cell's centre, the rest in units of the scales; the mean velocity
        weighted by speed, which one moving point among standing ones decides; log of 1 + the points' weight.
        """
        points = radar_points.float()
        cells = self.grid.cell_of(points[:, :2])
        rows = bev.sites.rows_of(torch.cat([radar_batch[:, None], cells], dim=1))
        if fixed_shapes() is not None:
            rows = torch.where(rows < 0, len(bev) - 1, rows)  # the last is padding
        else:
            near = (rows >= 0).nonzero().squeeze(1)
            points, rows = points[near], rows[near]
        velocities = points[:, 4:6] / self.point_scales[4:6]
        speeds = velocities.norm(dim=1, keepdim=True)
        values = [
            torch.ones_like(speeds),
            speeds,
            speeds * velocities,
            points[:, :2] / self.grid.cell_m,
            points[:, 2:] / self.point_scales[2:],
        ]
        sums = segment_sum(torch.cat(values, dim=1), rows, len(bev))
        window = submanifold_map(bev.sites, 3)
        for _ in range(PASSES):
            sums = neighbour_sum(sums, window)
        counts, speed_sums, velocity_sums, position_sums, other_sums = sums.split([1, 1, 2, 2, 5], dim=1)
        shares = 1.0 / counts.clamp(min=1.0)  # a point weighs at least 1, in its own cell's window
        positions = position_sums * shares - self.grid.centre_of(bev.indices[:, 1:]) / self.grid.cell_m * (counts > 0)
        moving = velocity_sums / speed_sums.clamp(min=MIN_SPEED_SUM)
        return torch.cat([positions, other_sums * shares, moving, counts.log1p()], dim=1)
