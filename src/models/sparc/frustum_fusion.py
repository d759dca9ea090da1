"""Sparse frustum fusion of SpaRC: radar points and image features exchange what they know along their frustum."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.errors import ConfigError, require_least
from src.geometry.bev_grid import BEVGrid
from src.models.layers.views import CameraViews
from src.models.sparc.point_transformer import RadarPoints
from src.ops.segment_reduce import segment_softmax, weighted_segment_sum


@dataclass(kw_only=True)
class FrustumFusionConfig:
    """Settings of the sparse frustum fusion (`model.fusion`)."""

    image_stride_px: int  # level of the image pyramid that takes part
    num_heights: int  # places on the vertical through a radar point, evenly over the height band

    def __post_init__(self) -> None:
        require_least(self, "model.fusion", {"image_stride_px": 1, "num_heights": 1})


@dataclass
class FrustumPairs:
    """Radar points and the image cells that lie in their frustum, ordered by point."""

    points: Tensor  # [n] int64, row of the radar point, ascending
    cells: Tensor  # [n] int64, row of the image cell, ((b * N + view) * h + row) * w + col
    places: Tensor  # [n, 3] height in the band (0..1), height over the point (its band), log range


class SparseFrustumFusion(nn.Module):
    """Cross-attention between radar points and the image cells that the vertical through each of them crosses.

    A radar knows range and azimuth, but hardly the elevation: its point may be anywhere on that vertical. One score a
    pair, q k / sqrt(C); points take from their cells by a softmax over these, cells from their points by one over
    those, so that images learn depth where the radar measures it.
    """

    def __init__(
        self,
        config: FrustumFusionConfig,
        radar_channels: int,
        image_channels: int,
        channels: int,
        strides_px: tuple[int, ...],  # of the image pyramid
        grid: BEVGrid,
    ) -> None:
        super().__init__()
        if config.image_stride_px not in strides_px:
            raise ConfigError(
                f"model.fusion.image_stride_px={config.image_stride_px}: must be one of the image encoder's strides, "
                f"{list(strides_px)}"
            )
        self.level, self.num_heights = strides_px.index(config.image_stride_px), config.num_heights
        self.z_range_m, self.channels = grid.z_range_m, channels
        self.points = nn.Linear(radar_channels, channels)
        self.query, self.key = nn.Linear(channels, channels), nn.Linear(image_channels, channels)
        self.place = nn.Linear(3, channels)
        self.to_points = nn.Linear(image_channels, channels)
        self.to_cells = nn.Linear(channels, image_channels)
        self.norm = nn.LayerNorm(channels)

    def forward(self, radar: RadarPoints, views: CameraViews) -> tuple[RadarPoints, CameraViews]:
        """Both with what the other knows: points of C channels, and the pyramid with its level changed."""
        level = views.levels[self.level]  # [B, N, C_I, h, w]
        cells = level.movedim(2, -1).flatten(0, 3)  # [B * N * h * w, C_I]
        points = self.points(radar.bev.features)  # [M, C]
        pairs = self.pairs(radar, views)
        key = F.embedding(pairs.cells, self.key(cells)) + self.place(pairs.places)
        scores = (F.embedding(pairs.points, self.query(points)) * key).sum(1).float() / math.sqrt(self.channels)

        weights = segment_softmax(scores, pairs.points, len(points))
        taken = self.to_points(cells).float()
        points = points + weighted_segment_sum(taken, weights, pairs.cells, pairs.points, len(points))
        points = self.norm(points)

        order = pairs.cells.argsort(stable=True)
        rows, picks = pairs.cells[order], pairs.points[order]
        weights = segment_softmax(scores[order], rows, len(cells))
        given = weighted_segment_sum(self.to_cells(points).float(), weights, picks, rows, len(cells))
        given = given.view(*level.shape[:2], *level.shape[3:], -1).movedim(-1, 2)
        levels = [x + given.to(x.dtype) if number == self.level else x for number, x in enumerate(views.levels)]
        return radar.with_features(points), replace(views, levels=levels)

    @torch.no_grad()
    def pairs(self, radar: RadarPoints, views: CameraViews) -> FrustumPairs:
        """Every place on a vertical that a camera sees; a cell with several of them counts as often."""
        low, high = self.z_range_m
        shares = (torch.arange(self.num_heights, device=radar.means.device) + 0.5) / self.num_heights
        padded = radar.padded()
        xy = padded.xyz[:, :, None, :2].expand(-1, -1, self.num_heights, -1)
        z = (low + (high - low) * shares).expand(*xy.shape[:3])
        pixels, visible = views.project(torch.cat([xy, z[..., None]], dim=-1))  # [B, G, N, P, 2], [B, G, N, P]
        visible = visible & padded.valid[:, :, None, None]
        sample, place, view, height = visible.nonzero().unbind(1)
        counts = padded.valid.sum(1)
        point = place + (counts.cumsum(0) - counts)[sample]
        h, w = views.levels[self.level].shape[-2:]
        col, row = (pixels[sample, place, view, height] * (h / views.image_size_px[0])).long().unbind(1)
        cell = ((sample * visible.shape[2] + view) * h + row.clamp(max=h - 1)) * w + col.clamp(max=w - 1)
        means, share = radar.means[point], shares[height]
        over = share - (means[:, 2] - low) / (high - low)
        return FrustumPairs(point, cell, torch.stack([share, over, means[:, :2].norm(dim=1).log1p()], dim=1))
