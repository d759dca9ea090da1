"""LiDAR points to voxel features: a point network and its maximum over each voxel (lrs 5.1, O7)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.geometry.constants import constant
from src.geometry.voxel_grid import VoxelGrid
from src.models.layers.sparse import RowBatchNorm
from src.ops.segment_reduce import segment_max, segment_mean
from src.ops.voxelize import voxel_rows
from src.structures.sparse_bev import SparseMap

POINT_FEATURES = 10
"""From the voxel's centre and from the mean of its points (3 each, in voxels), intensity, dt, radial speed, whether it
was measured."""
INTENSITY_SCALE = 100.0
TIME_SCALE_S = 0.5
SPEED_SCALE_MPS = 20.0


class VoxelPointNet(nn.Module):
    """One linear layer per point, norm and ReLU, then the maximum over all points of a voxel, however many.

    Runs in float32 also under autocast: it is small, and its inputs are positions.
    """

    full_precision_parts = ("",)
    norm_pairs = (("linear", "norm"),)

    def __init__(self, channels: int, grid: VoxelGrid, eps: float, momentum: float) -> None:
        super().__init__()
        self.grid = grid
        self.linear = nn.Linear(POINT_FEATURES, channels, bias=False)
        self.norm = RowBatchNorm(channels, eps=eps, momentum=momentum)

    def forward(
        self,
        points: Tensor,  # [P, 5] x, y, z (m, aug frame), intensity, dt (s)
        batch: Tensor,  # [P] int64 sample of each point
        batch_size: int,
        speeds_mps: Tensor | None = None,  # [P] measured along the ray, NaN where it was not; None: nowhere
    ) -> SparseMap:
        """Features of the voxels that hold points; points outside the grid are left out."""
        with torch.autocast(points.device.type, enabled=False):
            points = points.float()
            lower_m, voxel_m, cells = self.grid.lower_m, self.grid.voxel_m, self.grid.cells
            sites, rows, inside = voxel_rows(points[:, :3], batch, lower_m, voxel_m, cells, batch_size)
            speeds = points.new_full((len(points),), torch.nan) if speeds_mps is None else speeds_mps.float()
            points, speeds = points[inside], speeds[inside]
            xyz, size = points[:, :3], constant(voxel_m, points.dtype, points.device)
            centres = F.embedding(rows, self.grid.centre_of(sites.indices()[:, 1:]))
            means = F.embedding(rows, segment_mean(xyz, rows, len(sites)))
            columns = [
                (xyz - centres) / size,
                (xyz - means) / size,
                points[:, 3:4] / INTENSITY_SCALE,
                points[:, 4:5] / TIME_SCALE_S,
                speeds.nan_to_num(nan=0.0)[:, None] / SPEED_SCALE_MPS,
                speeds.isfinite()[:, None].float(),
            ]
            features = F.relu(self.norm(self.linear(torch.cat(columns, dim=1))))
            return SparseMap(sites, segment_max(features, rows, len(sites)))
