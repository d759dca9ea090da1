"""Radar points to a dense BEV map: pillars of one cell, encoded point by point (PointPillars; method 13)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.errors import ConfigError, require_least
from src.geometry.bev_grid import BEVGrid
from src.models.backbones.sparse_voxel import POINT_SCALES
from src.models.layers.dense import map_of_rows
from src.models.layers.sparse import RowBatchNorm
from src.ops.segment_reduce import segment_count, segment_max, segment_mean

EXTRA_FEATURES = 6
"""From the cell's centre (x, y), from the mean of the pillar's points (x, y, z), log of their number."""


@dataclass(kw_only=True)
class PillarConfig:
    """Settings of the radar encoder (`model.radar_encoder`). Raises ConfigError for values that cannot work."""

    channels: int  # width of the map; the layers before the last are half as wide and append their pillar's maximum
    num_layers: int  # of the point network

    def __post_init__(self) -> None:
        if self.channels < 2 or self.channels % 2:
            raise ConfigError(f"model.radar_encoder.channels={self.channels}: must be a positive even number")
        require_least(self, "model.radar_encoder", {"num_layers": 1})


class PillarEncoder(nn.Module):
    """Radar points to a map of `config.channels` over the whole grid, zero where no point fell.

    Runs in float32 also under autocast: it is small, and its inputs are positions.
    """

    full_precision_parts = ("",)

    def __init__(self, config: PillarConfig, grid: BEVGrid) -> None:
        super().__init__()
        self.grid = grid
        self.register_buffer("point_scales", torch.tensor(POINT_SCALES), persistent=False)
        self.layers, self.norms = nn.ModuleList(), nn.ModuleList()
        inputs = len(POINT_SCALES) + EXTRA_FEATURES
        for number in range(config.num_layers):
            width = config.channels if number == config.num_layers - 1 else config.channels // 2
            self.layers.append(nn.Linear(inputs, width, bias=False))
            self.norms.append(RowBatchNorm(width))
            inputs = config.channels

    @property
    def norm_pairs(self) -> list[tuple[str, str]]:
        """Name of each layer with that of its norm, which inference folds into it."""
        return [(f"layers.{number}", f"norms.{number}") for number in range(len(self.layers))]

    def forward(
        self,
        radar_points: Tensor,  # [P, 7] x, y, z (m, aug frame), rcs (dB), vx, vy (m/s), dt (s)
        radar_batch: Tensor,  # [P] int64 sample of each point
        batch_size: int,
    ) -> Tensor:  # [B, C, rows, cols] float32, channels last
        """The map; points outside the grid or its height band are left out."""
        pillars, cells, _ = self.encode(radar_points, radar_batch)
        shape = (batch_size, self.grid.rows, self.grid.cols)
        whole = pillars.new_zeros(torch.Size(shape).numel(), pillars.shape[1])
        return map_of_rows(whole.index_copy(0, cells, pillars), shape)

    def encode(
        self,
        radar_points: Tensor,  # [P, 7] as above
        radar_batch: Tensor,  # [P] int64 sample of each point
    ) -> tuple[Tensor, Tensor, Tensor]:  # [V, C] float32, [V] int64, [V, 7]
        """Pillars of one cell alone, their linear keys (sample * rows + row) * cols + col, ascending, and the means of
        their points; points outside the grid or its height band are left out."""
        with torch.autocast(radar_points.device.type, enabled=False):
            features, cells, rows, means = self.describe(radar_points.float(), radar_batch)
            for layer, norm in zip(self.layers, self.norms, strict=True):
                points = F.relu(norm(layer(features)))
                pillars = segment_max(points, rows, len(cells))  # [V, width]
                features = torch.cat([points, F.embedding(rows, pillars)], dim=1)
        return pillars, cells, means

    def describe(
        self,
        points: Tensor,  # [P, 7]
        batch: Tensor,  # [P] int64
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # [n, 13], [V] int64, [n] int64, [V, 7]
        """Features of the points inside, linear keys of the pillars they form, the pillar of each point, and the mean
        point of each pillar."""
        kept = self.grid.contains_points(points).nonzero().squeeze(1)
        points, batch = points[kept], batch[kept]
        cell = self.grid.cell_of(points[:, :2])
        cells, rows = torch.unique(self.grid.keys_of(batch, cell), return_inverse=True)
        from_centre = (points[:, :2] - self.grid.centre_of(cell)) / self.grid.cell_m
        means = segment_mean(points, rows, len(cells))
        units = points.new_tensor([self.grid.cell_m, self.grid.cell_m, POINT_SCALES[2]])
        from_mean = (points[:, :3] - F.embedding(rows, means[:, :3])) / units
        count = segment_count(rows, len(cells)).to(points.dtype).log()[rows]
        features = torch.cat([points / self.point_scales, from_centre, from_mean, count[:, None]], dim=1)
        return features, cells, rows, means
