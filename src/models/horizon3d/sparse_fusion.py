"""Gated fusion of the Gaussian and the radar map on the union of their cells (Eq. 11-12)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.models.layers.sparse import RowNorm, SubmanifoldConv
from src.ops.kernel_maps import stacked_map
from src.ops.segment_reduce import permute_rows
from src.ops.sites import union
from src.ops.sparse_conv import sparse_conv
from src.structures.sparse_bev import SparseBEV


class SparseFusion(nn.Module):
    """w = sigmoid(psi([F_G, F_R])) per branch and channel, then a residual block on [w_G F_G, w_R F_R].

    Each branch is normalised first, since F_G is a sum whose scale follows how crowded a cell is; a branch without a
    site in a cell counts as zero there. Those zeros are never computed with: gates and products exist on a branch's own
    cells only, and the first convolution and the shortcut read the branches stacked instead of side by side.
    """

    norm_pairs = (("conv1", "norm1"), ("conv2", "norm2"))

    def __init__(self, channels: int, gate_kernel_size: int) -> None:
        super().__init__()
        both = 2 * channels
        self.gate_kernel_size = gate_kernel_size
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
        gaussian, radar = self.norm_gaussian(gaussian_bev.features), self.norm_radar(radar_bev.features)
        sites, *rows = union(gaussian_bev.sites, radar_bev.sites)
        place_gaussian, place_radar = (_places(part, len(sites)) for part in rows)
        radar_there, gaussian_there = place_radar.index_select(0, rows[0]), place_gaussian.index_select(0, rows[1])
        pairs = (
            torch.cat([gaussian, permute_rows(radar, radar_there, gaussian_there)], dim=1),  # [G, 2C] F_G's cells
            torch.cat([permute_rows(gaussian, gaussian_there, radar_there), radar], dim=1),  # [R, 2C] F_R's cells
        )
        if self.gate_kernel_size == 1:
            gates = [_at_own_cells(conv, pair) for conv, pair in zip(self._gates, pairs, strict=True)]
        else:
            joined = torch.cat(
                [
                    permute_rows(gaussian, place_gaussian, rows[0]),
                    permute_rows(radar, place_radar, rows[1]),
                ],
                dim=1,
            )  # [M, 2C]
            gates = [
                conv(SparseBEV(sites, joined)).features.index_select(0, part)
                for conv, part in zip(self._gates, rows, strict=True)
            ]
        gated = (gates[0].sigmoid() * gaussian, gates[1].sigmoid() * radar)  # [G, C], [R, C]
        weight = torch.cat(self.conv1.weight.chunk(2, dim=1))
        x = sparse_conv(torch.cat(gated), weight, stacked_map(sites, self.conv1.kernel_size, rows), self.conv1.bias)
        x = self.conv2(SparseBEV(sites, F.relu(self.norm1(x), inplace=True)))
        y = self.norm2(x.features)
        for part, matrix, place, own in zip(
            gated, self.shortcut.weight[0].chunk(2), (place_gaussian, place_radar), rows, strict=True
        ):
            y = y + permute_rows(part @ matrix, place, own)
        return x.with_features(F.relu(y, inplace=True))

    @property
    def _gates(self) -> tuple[SubmanifoldConv, SubmanifoldConv]:
        return self.gate_gaussian, self.gate_radar


def _places(rows: Tensor, count: int) -> Tensor:  # [count] int64
    """Where each of `count` rows stands in `rows`, -1 for those it lacks."""
    place = rows.new_full((count,), -1)
    place[rows] = torch.arange(len(rows), device=rows.device)
    return place


def _at_own_cells(conv: SubmanifoldConv, features: Tensor) -> Tensor:
    """A convolution of kernel size 1, which needs no sites."""
    return F.linear(features, conv.weight[0].t(), conv.bias)
