"""Measured speeds: where returns are at the key time, which voxels move, and where those are at another (ours)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.geometry.voxel_grid import VoxelGrid
from src.losses.normalizers import full_precision
from src.ops.ball_query import OFFSETS, ball_query
from src.ops.segment_reduce import segment_mean, segment_sum
from src.ops.sites import Sites
from src.ops.voxelize import voxel_rows
from src.structures.batch import FrameBatch
from src.structures.sparse_bev import SparseMap
from src.structures.taxonomy import MOVING_MPS

TIME_STEP_S = 0.05
"""Queries whose times round to the same step see the moving voxels at one place: at 30 m/s up to 0.75 m off."""
LEAST_COSINE = 0.3
"""Between a ray and the heading: nearer to a right angle a radial speed says too little of one along the heading."""


@dataclass
class MeasuredMotion:
    """One scale of the volume of B samples, split into what is measured to move and the rest; aug frames.

    What moves is taken to go along the ego's heading, as on a road: along the ray it would leave a car that is 20
    degrees to the side by a third of its speed.
    """

    grid: VoxelGrid
    rest: SparseMap  # [n, C] the voxels that are not measured to move
    rows: Tensor  # [m] int64, those that are, among all
    xyz: Tensor  # [m, 3] m, their centres
    velocities: Tensor  # [m, 3] m/s over ground
    features: Tensor  # [m, C]
    batch: Tensor  # [m] int64
    origins: Tensor  # [B, 3] m, `sensor_origins`
    ego_mps: Tensor  # [B, 3] the ego's velocity, NaN where unknown

    @classmethod
    def of(
        cls,
        volume: SparseMap,  # [n + m, C] on (B, z, y, x)
        grid: VoxelGrid,  # of the volume
        batch: FrameBatch,  # with LiDAR and its origins
        velocities: Tensor,  # [L, 3] `return_velocities`
        ego_mps: Tensor,  # [B, 3] m/s, aug frame, NaN where unknown
    ) -> MeasuredMotion:
        """A voxel moves where half of its measured returns do, or, where it has none, of the `ball_query` around it."""
        indices = volume.indices
        velocities = _velocities_around(grid, batch, velocities, indices)
        moves = velocities.norm(dim=1) > MOVING_MPS
        rows, stays = moves.nonzero().squeeze(1), (~moves).nonzero().squeeze(1)
        features = full_precision(volume.features)
        rest = SparseMap(Sites(volume.sites.shape, volume.sites.keys[stays]), F.embedding(stays, features))
        xyz, owners = grid.centre_of(indices[rows, 1:]), indices[rows, 0]
        return cls(
            grid, rest, rows, xyz, velocities[rows], F.embedding(rows, features), owners, sensor_origins(batch), ego_mps
        )

    def seen_at(
        self,
        points: Tensor,  # [Q, 3] m
        times_s: Tensor,  # [Q]
        batch: Tensor,  # [Q] int64
        neighbours: int,  # of `ball_query`
    ) -> tuple[Tensor, Tensor, Tensor]:  # [Q, C], [Q, 3] m, [Q] m/s
        """If all that moves keeps its velocity: features at every place and time, where those are now, their speed.

        The speed is along the ray from where the sensors are by then, if the ego drives on as well, or along the
        present ray where its velocity is unknown; 0 where nothing moves. Differentiable in the features.
        """
        steps = (times_s / TIME_STEP_S).round().long()
        span = 1 + 2 * int(steps.abs().max()) if len(steps) else 1
        codes, moment = torch.unique(batch * span + steps + span // 2, return_inverse=True)
        samples, moments_s = codes // span, (codes % span - span // 2) * TIME_STEP_S
        own, row = (samples[:, None] == self.batch).nonzero().unbind(1)
        there = self.xyz[row] + self.velocities[row] * moments_s[own, None]
        inside = self.grid.contains(there).nonzero().squeeze(1)
        own, row, there = own[inside], row[inside], there[inside]
        indices = torch.cat([own[:, None], self.grid.cell_of(there)], dim=1)
        sites, owners = Sites.unique(indices, (len(codes), *self.grid.cells))
        columns = torch.cat([self.features, self.velocities, torch.ones_like(self.velocities[:, :1])], dim=1)
        moved = segment_mean(F.embedding(row, columns), owners, len(sites))
        found = ball_query(moved, sites, self.grid, points, moment, neighbours)
        features, velocities, met = found.split([self.features.shape[1], 3, 1], dim=1)
        here = ball_query(self.rest.features, self.rest.sites, self.grid, points, batch, neighbours)
        velocities = velocities.detach()
        source = points - velocities * times_s[:, None]
        driven = torch.where(self.ego_mps[batch].isnan(), velocities, self.ego_mps[batch])
        rays = F.normalize(points - self.origins[batch] - driven * times_s[:, None], dim=1)
        return torch.where(met > 0, features, here), source, (velocities * rays).sum(1)

    def on_ground(
        self,
        grid: BEVGrid,
    ) -> Tensor:  # [B, 2, rows, cols] m/s
        """The mean velocity over ground of what moves in each cell, or else in the eight around it; else 0.

        As in `head_targets` a cell stands for its lower corner.
        """
        xy = self.xyz[:, :2] + 0.5 * grid.cell_m
        inside = grid.contains(xy).nonzero().squeeze(1)
        cells = grid.keys_of(self.batch[inside], grid.cell_of(xy[inside]))
        shape = (len(self.origins), grid.rows, grid.cols)
        columns = F.pad(self.velocities[inside, :2], (0, 1), value=1.0)
        sums = segment_sum(columns, cells, math.prod(shape)).unflatten(0, shape).permute(0, 3, 1, 2)
        sums = torch.where(sums[:, 2:] > 0, sums, F.avg_pool2d(sums, 3, stride=1, padding=1))
        return sums[:, :2] / torch.where(sums[:, 2:] > 0, sums[:, 2:], 1)


def ego_heading(batch: FrameBatch) -> Tensor:  # [B, 3]
    """Unit vectors, aug frame."""
    return F.normalize(batch.aug_from_ego[:, :3, 0], dim=1)


def sensor_origins(batch: FrameBatch) -> Tensor:  # [B, 3] m
    """Where the LiDARs were when they measured, in the mean over the points of each sample."""
    return segment_mean(batch.lidar_origins, batch.lidar_batch, len(batch))


def directions(
    rays: Tensor,  # [n, 3] from the sensor, of any length
    heading: Tensor | None,  # [n, 3] unit vectors that the road goes along; None: everything moves along its ray
) -> Tensor:  # [n, 3]
    """What a radial speed is multiplied with for a velocity: the unit ray r, or h / (r h) for a heading h.

    Where |r h| is below LEAST_COSINE it is r again.
    """
    rays = F.normalize(rays, dim=1)
    if heading is None:
        return rays
    cosine = (rays * heading).sum(1, keepdim=True)
    return torch.where(cosine.abs() < LEAST_COSINE, rays, heading / cosine)


def return_velocities(
    batch: FrameBatch,  # with `lidar_speeds`
) -> Tensor:  # [L, 3] m/s over ground, aug frame
    """By each return's own ray and speed; 0 up to MOVING_MPS, NaN where the speed is unknown."""
    speeds, points = batch.lidar_speeds[:, None], batch.lidar_points[:, :3]
    along = directions(points - batch.lidar_origins, ego_heading(batch)[batch.lidar_batch])
    return torch.where(speeds.abs() <= MOVING_MPS, 0, speeds * along)


def at_key_time(
    points: Tensor,  # [L, 5] as `FrameBatch.lidar_points`
    velocities: Tensor,  # [L, 3] `return_velocities`
) -> Tensor:  # [L, 5]
    """Where what returned them is when the frame is taken: in 50 ms a car drives 1.5 m."""
    moved = points[:, :3] + velocities.nan_to_num() * points[:, 4:]
    return torch.cat([moved, points[:, 3:]], dim=1)


def _velocities_around(
    grid: VoxelGrid,
    batch: FrameBatch,
    velocities: Tensor,  # [L, 3] m/s of its returns
    indices: Tensor,  # [n, 4] int64, voxels
) -> Tensor:  # [n, 3] m/s
    """Of the returns that move where those are at least half of the measured ones, else 0."""
    known = velocities.isfinite().all(1).nonzero().squeeze(1)
    points, owners, velocities = batch.lidar_points[known, :3], batch.lidar_batch[known], velocities[known]
    move = velocities.any(1, keepdim=True).to(velocities.dtype)
    sites, voxels, inside = voxel_rows(points, owners, grid.lower_m, grid.voxel_m, grid.cells, len(batch))
    means = segment_mean(torch.cat([velocities, move], dim=1)[inside], voxels, len(sites))
    found = ball_query(means, sites, grid, grid.centre_of(indices[:, 1:]), indices[:, 0], len(OFFSETS))
    rows = sites.rows_of(indices)
    own = (rows >= 0).nonzero().squeeze(1)
    velocities, share = found.index_copy(0, own, means[rows[own]]).split([3, 1], dim=1)
    return torch.where(share < 0.5, 0, velocities / share.clamp(min=0.5))
