"""Gated fusion of the Gaussian and the radar map on the union of their cells (Eq. 11-12)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import nn

from src.models.sparse_layers import RowNorm, SubmanifoldConv
from src.structures.sparse_bev import SparseBEV


class SparseFusion(nn.Module):
    """w = sigmoid(psi([F_G, F_R])) per branch and channel, then a residual block on [w_G F_G, w_R F_R].

    Each branch is normalised first, since F_G is a sum whose scale follows how crowded a cell is; a branch without a
    site in a cell counts as zero there.
    """

    def __init__(self, channels: int, gate_kernel_size: int) -> None:
        super().__init__()
        both = 2 * channels
        self.norm_gaussian, self.norm_radar = RowNorm(channels), RowNorm(channels)
        self.gate_gaussian = SubmanifoldConv(both, channels, gate_kernel_size, 2, bias=True)
        self.gate_radar = SubmanifoldConv(both, channels, gate_kernel_size, 2, bias=True)
        self.conv1 = SubmanifoldConv(both, channels, 3, 2, bias=False)
        self.norm1 = RowNorm(channels)
        self.conv2 = SubmanifoldConv(channels, channels, 3, 2, bias=False)
        self.norm2 = RowNorm(channels)
        self.shortcut = SubmanifoldConv(both, channels, 1, 2, bias=False)

    def forward(self, gaussian_bev: SparseBEV, radar_bev: SparseBEV) -> SparseBEV:
        """F_fuse on the cells of either map."""
        gaussian, radar = gaussian_bev.with_features(self.norm_gaussian(gaussian_bev.features)).union(
            radar_bev.with_features(self.norm_radar(radar_bev.features))
        )
        joined = gaussian.with_features(torch.cat([gaussian.features, radar.features], dim=1))  # [M, 2C]
        gates = torch.cat([self.gate_gaussian(joined).features, self.gate_radar(joined).features], dim=1).sigmoid()
        gated = joined.with_features(gates * joined.features)
        x = self.conv1(gated)
        x = self.conv2(x.with_features(F.relu(self.norm1(x.features))))
        return x.with_features(F.relu(self.norm2(x.features) + self.shortcut(gated).features))
