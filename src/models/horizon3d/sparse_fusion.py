"""Gated fusion of the Gaussian and the radar map on the union of their cells (Eq. 11-12)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import nn

from src.models.layers.sparse import RowBatchNorm, SubmanifoldConv
from src.ops.gated_fusion import gated_fusion_conv
from src.structures.sparse_bev import SparseBEV


class SparseFusion(nn.Module):
    """F_fuse = E([w_G F_G, w_R F_R]) with gates w = sigmoid(psi([F_G, F_R])) per branch and channel (Eq. 11-12).

    E is a residual block. Each branch is normalised first, since F_G is a sum whose scale follows how crowded a cell
    is; a branch without a site in a cell counts as zero there. With `identity_start` an untrained F_fuse is the
    positive part of the normalised F_R, and zero on cells that only Gaussians have.
    """

    norm_pairs = (("conv1", "norm1"), ("conv2", "norm2"))
    skip_zeros = True
    """Compute both equations by `gated_fusion_conv`. The literal form multiplies zeros in half of the rows: some 5 % of
    a training step and of a frame on a CPU (mini scale)."""

    def __init__(self, channels: int, gate_kernel_size: int, identity_start: bool) -> None:
        super().__init__()
        both = 2 * channels
        self.norm_gaussian, self.norm_radar = RowBatchNorm(channels), RowBatchNorm(channels)
        self.gate_gaussian = SubmanifoldConv(both, channels, gate_kernel_size, 2, bias=True)
        self.gate_radar = SubmanifoldConv(both, channels, gate_kernel_size, 2, bias=True)
        self.conv1 = SubmanifoldConv(both, channels, 3, 2, bias=False)
        self.norm1 = RowBatchNorm(channels)
        self.conv2 = SubmanifoldConv(channels, channels, 3, 2, bias=False)
        self.norm2 = RowBatchNorm(channels)
        self.shortcut = SubmanifoldConv(both, channels, 1, 2, bias=False)
        if identity_start:
            for part in (self.gate_gaussian, self.gate_radar):  # open by half
                nn.init.zeros_(part.weight)
                nn.init.zeros_(part.bias)
            nn.init.zeros_(self.norm2.weight)
            self.shortcut.weight.data[0] = torch.cat([torch.zeros(channels, channels), 2 * torch.eye(channels)])

    def forward(self, gaussian_bev: SparseBEV, radar_bev: SparseBEV) -> SparseBEV:
        """F_fuse on the cells of either map."""
        f_g = gaussian_bev.with_features(self.norm_gaussian(gaussian_bev.features))
        f_r = radar_bev.with_features(self.norm_radar(radar_bev.features))
        if self.skip_zeros:
            x, shortcut = self._skip_zeros(f_g, f_r)
        else:
            f_g, f_r = f_g.union(f_r)  # zero where a branch has no site
            both = f_g.with_features(torch.cat([f_g.features, f_r.features], dim=1))  # [F_G, F_R]
            w_g = self.gate_gaussian(both).features.sigmoid()  # Eq. 11
            w_r = self.gate_radar(both).features.sigmoid()
            h = both.with_features(torch.cat([w_g * f_g.features, w_r * f_r.features], dim=1))  # H of Eq. 12
            x, shortcut = self.conv1(h), [self.shortcut(h).features]
        x = self.conv2(x.with_features(F.relu(self.norm1(x.features), inplace=True)))
        y = sum(shortcut, self.norm2(x.features))
        return x.with_features(F.relu(y, inplace=True))

    def _skip_zeros(self, f_g: SparseBEV, f_r: SparseBEV) -> tuple[SparseBEV, tuple[torch.Tensor, torch.Tensor]]:
        """conv1(H), and shortcut(H) as the addends of either branch."""
        gates = [(gate.weight, gate.bias) for gate in (self.gate_gaussian, self.gate_radar)]
        sites, x, shortcut = gated_fusion_conv(
            (f_g.features, f_r.features),
            (f_g.sites, f_r.sites),
            gates,
            self.conv1.weight,
            self.conv1.bias,
            self.shortcut.weight[0],
        )
        return SparseBEV(sites, x), shortcut
