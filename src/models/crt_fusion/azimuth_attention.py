"""Attention of image columns to the radar in their direction."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from src.geometry.bev_grid import BEVGrid
from src.geometry.tensor_transforms import pixel_centres
from src.models.layers.dense import MapConv2d, rows_of_map
from src.models.layers.sparse import LinearNormReLU
from src.models.layers.views import CameraViews
from src.ops.linear import linear
from src.ops.segment_reduce import segment_sum

UNSEEN = -1e4
"""Score of a place without a pillar: no weight beside any other, and no NaN where a column has none at all."""


class AzimuthAttention(nn.Module):
    """Radar-camera azimuth attention (CRT-Fusion's RCA): what the radar returns in the direction of each image column.

    A column, collapsed to its maximum over the rows, attends to the K pillars nearest in azimuth; a row, collapsed over
    the columns, says how high. Their sum joins the image, each weighted by a gate. Azimuths are seen from the camera:
    the public code takes them from the ego's origin, where a column's depends on a depth.
    """

    def __init__(
        self,
        channels: int,
        radar_channels: int,
        hidden_channels: int,
        count: int,  # K
        grid: BEVGrid,
    ) -> None:
        super().__init__()
        self.grid, self.count = grid, count
        self.pillars = LinearNormReLU(radar_channels, radar_channels)
        self.columns = LinearNormReLU(channels, channels // 2)
        self.rows = LinearNormReLU(channels, channels)
        self.pairs = nn.Sequential(
            LinearNormReLU(radar_channels + channels // 2, hidden_channels),
            LinearNormReLU(hidden_channels, channels),
        )
        self.score = nn.Linear(channels, 1)
        self.gates = MapConv2d(channels, 2 * channels, 3, padding=1)

    def forward(
        self,
        views: CameraViews,  # one level [B, N, C, h, w]
        radar_bev: Tensor,  # [B, C_radar, rows, cols], zero where no point fell
    ) -> Tensor:  # [B*N, C, h, w]
        """The image features with radar; a missing camera takes none."""
        (b, n, c, h, w), level = views.levels[0].shape, views.levels[0].flatten(0, 1)
        cells = radar_bev.any(1).nonzero()  # [P, 3] (sample, row, col) of the pillars, sample by sample
        keys = self.grid.keys_of(cells[:, 0], cells[:, 1:])
        columns = self.columns(level.amax(2).transpose(1, 2).flatten(0, 1))  # [B*N*w, C / 2]
        rows = self.rows(level.amax(3).transpose(1, 2).flatten(0, 1)).view(b * n, h, c)
        nearest = self.nearest(cells, views, w)  # [B*N*w, K]
        seen = (nearest.flatten() >= 0).nonzero().squeeze(1)  # [pairs]
        column = torch.div(seen, self.count, rounding_mode="floor")
        pillars = self.pillars(rows_of_map(radar_bev)[keys])[nearest.flatten()[seen]]
        values = self.pairs(torch.cat([pillars, columns[column].to(pillars.dtype)], dim=1))  # [pairs, C]
        scores = linear(values, self.score.weight.t(), self.score.bias).float().squeeze(1)
        scores = scores.new_full((nearest.numel(),), UNSEEN).index_copy(0, seen, scores)
        weights = scores.view_as(nearest).softmax(1).flatten()[seen]
        found = segment_sum(weights[:, None] * values.float(), column, len(nearest)).view(b * n, w, c)
        radar = (found.transpose(1, 2)[:, :, None] + rows.transpose(1, 2)[..., None]) * views.valid.view(-1, 1, 1, 1)
        for_image, for_radar = self.gates(level + radar).sigmoid().chunk(2, dim=1)
        return level * for_image + radar * for_radar

    @torch.no_grad()
    def nearest(
        self,
        cells: Tensor,  # [P, 3] int64 (sample, row, col), sample by sample
        views: CameraViews,
        num_columns: int,  # w
    ) -> Tensor:  # [B*N*w, K] int64 row of `cells`; -1: there are fewer, or the camera is missing
        """The K pillars of its own sample whose azimuth is nearest to that of each column, taken at mid height."""
        (b, n), aug_from_pix, image_size_px = views.valid.shape, views.aug_from_pix, views.image_size_px
        u, _, _ = pixel_centres(image_size_px, (1, num_columns), cells.device)[0].unbind(-1)  # [w]
        axes = aug_from_pix[:, :, None, :2]  # [B, N, 1, 2, 4]
        rays = axes[..., 0] * u[:, None] + axes[..., 1] * (image_size_px[0] / 2) + axes[..., 2]  # [B, N, w, 2]
        azimuth = torch.atan2(rays[..., 1], rays[..., 0])
        xy = self.grid.centre_of(cells[:, 1:])
        found = cells.new_full((b, n, num_columns, self.count), -1)
        first = 0
        for sample, count in enumerate(torch.bincount(cells[:, 0], minlength=b).tolist()):
            own = xy[first : first + count] - aug_from_pix[sample, :, None, :2, 3]  # [N, count, 2] from the camera
            apart = torch.atan2(own[..., 1], own[..., 0])[:, None] - azimuth[sample, :, :, None]  # [N, w, count]
            apart = (torch.remainder(apart + math.pi, 2 * math.pi) - math.pi).abs()
            best = apart.topk(min(self.count, count), dim=2, largest=False).indices + first
            found[sample, :, :, : best.shape[2]] = torch.where(views.valid[sample, :, None, None], best, -1)
            first += count
        return found.flatten(0, 2)
