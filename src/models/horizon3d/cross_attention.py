"""Deformable attention from Gaussians to the sparse radar map (Eq. 2, method 5.2)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from src.geometry.bev_grid import BEVGrid
from src.geometry.constants import arange
from src.models.layers.feed_forward import NUM_HEADS, attention_linear
from src.ops.deform_sample import deform_attend_bev
from src.ops.linear import linear
from src.structures.sparse_bev import SparseBEV


class RadarCrossAttention(nn.Module):
    """Deformable attention from Gaussians to the sparse radar map (DCA_R of Eq. 2)."""

    def __init__(self, channels: int, num_points: int, grid: BEVGrid) -> None:
        super().__init__()
        self.grid = grid
        self.num_points = num_points
        self.value = attention_linear(channels, channels)
        self.logits = attention_linear(channels, NUM_HEADS * num_points, zero=True)
        self.output = attention_linear(channels, channels)

    def forward(
        self,
        query: Tensor,  # [B, G, C]
        points: Tensor,  # [B, G, P, 2] aug metres
        radar_bev: SparseBEV,
    ) -> Tensor:  # [B, G, C]
        """Weighted bilinear samples; cells without a site and points beyond the grid count as zero."""
        b, g = query.shape[:2]
        values = linear(radar_bev.features, self.value.weight.t(), self.value.bias)
        values = values.unflatten(-1, (NUM_HEADS, -1))  # [M, heads, C / heads]
        weights = self.logits(query).float().unflatten(-1, (NUM_HEADS, self.num_points)).softmax(-1)
        sample = arange(b, torch.int64, query.device)[:, None].expand(b, g).flatten()
        gathered = deform_attend_bev(
            values, radar_bev.sites, points.flatten(0, 1), sample, weights.flatten(0, 1), self.grid
        )
        return self.output(gathered.to(values.dtype)).unflatten(0, (b, g))
