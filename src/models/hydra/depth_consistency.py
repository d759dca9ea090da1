"""Radar-weighted depth consistency of HyDRa: foreground cells look back at the images, where depth agrees."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.errors import ConfigError, require_least
from src.geometry.bev_grid import BEVGrid
from src.models.layers.dense import DenseConvNormReLU, MapConv2d, map_of_rows, rows_of_map
from src.models.layers.feed_forward import attention_linear, feed_forward
from src.models.layers.full_precision import FullPrecisionConv2d
from src.models.layers.image_attention import ImageCrossAttention
from src.models.layers.query_attention import SinePositionEmbedding
from src.models.layers.views import CameraViews
from src.structures.taxonomy import CAMERAS
from src.targets.depth import lid_index

FFN_RATIO = 4
"""Width of the MLP's hidden layer over the channels, as in the public FB-BEV."""
FOREGROUND_STRIDE = 2
"""Cells of the map per place where foreground is predicted, along either axis; between these it is bilinear."""
FOREGROUND_BIAS = -4.6
"""An untrained cell is foreground with probability 0.01."""
RADAR_BIAS = -2.0
"""An untrained radar vouches for its cell with a weight of 0.12."""


@dataclass(kw_only=True)
class DepthConsistencyConfig:
    """Settings of the backward projection (`model.refinement`)."""

    num_queries: int  # cells of a frame that look back, those most likely foreground
    num_points: int  # on the vertical through a cell, evenly over the height band

    def __post_init__(self) -> None:
        require_least(self, "model.refinement", {"num_queries": 1, "num_points": 1})


class DepthConsistency(nn.Module):
    """Backward projection as in FB-BEV, with radar-weighted depth consistency (RDC).

    Lifting leaves cells empty that no pixel is sure to lie in. The likeliest foreground cells are queries that sample
    the images at points on their vertical by deformable attention, each sample weighted by how well the pixel's depth
    agrees with the point's. What comes back is added to the map at these cells. Raises ConfigError for more queries
    than cells.
    """

    def __init__(
        self,
        config: DepthConsistencyConfig,
        channels: int,
        context_channels: int,
        depth_range_m: tuple[float, float],
        grid: BEVGrid,
    ) -> None:
        super().__init__()
        cells = grid.rows * grid.cols
        if config.num_queries > cells:
            raise ConfigError(f"model.refinement.num_queries={config.num_queries}: the grid has only {cells} cells")
        self.config, self.grid, self.depth_range = config, grid, depth_range_m
        self.foreground = nn.Sequential(
            DenseConvNormReLU(channels, channels // 2, 3, FOREGROUND_STRIDE), FullPrecisionConv2d(channels // 2, 1, 1)
        )
        nn.init.constant_(self.foreground[1].bias, FOREGROUND_BIAS)
        self.place = SinePositionEmbedding(channels, grid, coordinates=2)
        self.offset = attention_linear(channels, 3 * config.num_points, zero=True)
        self.radar = nn.Linear(channels, 1)
        nn.init.constant_(self.radar.bias, RADAR_BIAS)
        self.value = MapConv2d(context_channels, channels, 1)
        self.attention = ImageCrossAttention(channels, config.num_points, len(CAMERAS), num_levels=1)
        self.norm = nn.LayerNorm(channels)
        self.mlp = feed_forward(channels, FFN_RATIO)

    def forward(
        self,
        fused: Tensor,  # [B, C, rows, cols]
        radar_bev: Tensor,  # [B, C_radar, rows, cols], zero where no point fell
        views: CameraViews,  # one level, the context [B, N, C_context, h, w]
        depth_logits: Tensor,  # [B, N, D, h, w]
    ) -> tuple[Tensor, Tensor]:  # [B, C, rows, cols], [B, rows, cols] float32 logits
        """The refined map and the foreground that chose where."""
        (context,) = views.levels
        coarse, rows = self.foreground(fused), rows_of_map(fused)
        logits = F.interpolate(coarse, size=fused.shape[2:], mode="bilinear", align_corners=False).squeeze(1)
        picks = logits.detach().flatten(1).topk(self.config.num_queries).indices  # [B, Q]
        keys = picks + torch.arange(len(picks), device=picks.device)[:, None] * logits[0].numel()
        row = torch.div(picks, self.grid.cols, rounding_mode="floor")
        centres = self.grid.centre_of(torch.stack([row, picks % self.grid.cols], dim=-1))  # [B, Q, 2]

        x = F.embedding(keys, rows)
        query = x + self.place(centres).to(x.dtype)
        points = self.points(query, centres)
        trust = self.radar_weight(x, rows_of_map(radar_bev)[keys].any(-1))
        weights = self.consistency(points, trust, views, depth_logits)
        values = self.value(context.flatten(0, 1)).unflatten(0, context.shape[:2])
        x = self.norm(x + self.attention(x, query, points, views, [values], weights))
        refined = rows.index_add(0, keys.flatten(), self.mlp(x).flatten(0, 1).to(rows.dtype))
        return map_of_rows(refined, logits.shape), logits

    def points(
        self,
        query: Tensor,  # [B, Q, C]
        centres: Tensor,  # [B, Q, 2] m
    ) -> Tensor:  # [B, Q, P, 3] aug metres
        """Where each cell looks: at P heights, each moved by an offset that the query learns, in cells."""
        low, high = self.grid.z_range_m
        shares = (torch.arange(self.config.num_points, device=centres.device) + 0.5) / self.config.num_points
        xy = centres[:, :, None].expand(-1, -1, self.config.num_points, -1)
        z = (low + (high - low) * shares).expand(xy.shape[:3])
        offsets = self.offset(query).float().unflatten(-1, (-1, 3))
        return torch.cat([xy, z[..., None]], dim=-1) + self.grid.cell_m * offsets

    def radar_weight(
        self,
        x: Tensor,  # [B, Q, C]
        returned: Tensor,  # [B, Q] bool, whether the radar returned anything from the cell
    ) -> Tensor:  # [B, Q] float32
        """How far the radar alone vouches that there is something in a cell: nothing where it returned nothing."""
        return self.radar(x).float().squeeze(-1).sigmoid() * returned

    def consistency(
        self,
        points: Tensor,  # [B, Q, P, 3] aug metres
        trust: Tensor,  # [B, Q]
        views: CameraViews,
        depth_logits: Tensor,  # [B, N, D, h, w]
    ) -> Tensor:  # [B, Q, N, P] float32
        """w = 1 - (1 - d_P d_Q) (1 - trust): depth agrees, or radar vouches for the cell.

        d_P is the depth distribution of the pixel that shows the point, d_Q one at the bin of the point's own depth, so
        that d_P d_Q is the probability of that bin (FB-BEV's w_c); it is 0 where no camera sees the point or where its
        depth lies outside all bins. A radar's range says more of a cell than any pixel's depth.
        """
        (b, n, num_bins), (h, w) = depth_logits.shape[:3], depth_logits.shape[-2:]
        with torch.autocast(points.device.type, enabled=False):
            probabilities = rows_of_map(depth_logits.flatten(0, 1).float()).softmax(1)  # [B*N*h*w, D]
            with torch.no_grad():
                pixels, visible = views.project(points)  # [B, Q, N, P, 2], [B, Q, N, P]
                axis = views.pix_from_aug.float()[:, None, :, None, 2]  # [B, 1, N, 1, 4]
                depth = (axis[..., :3] * points[:, :, None]).sum(-1) + axis[..., 3]
                bins = lid_index(depth, self.depth_range, num_bins)
                known = visible & (bins >= 0)
                col, row = (pixels * (h / views.image_size_px[0])).long().unbind(-1)
                image = torch.arange(b * n, device=points.device).view(b, 1, n, 1)
                places = ((image * h + row.clamp(max=h - 1)) * w + col.clamp(max=w - 1)) * num_bins + bins
                places = torch.where(known, places, 0)
            agreed = F.embedding(places, probabilities.view(-1, 1)).squeeze(-1) * known
            return 1 - (1 - agreed) * (1 - trust[..., None, None])
