"""Context for a head on sparse cells: down by strided convolutions and back up to the same cells."""

from __future__ import annotations

from collections.abc import Sequence

from torch import nn

from src.models.layers.sparse import ConvNormReLU, ResidualBlock, SparseConv, SparseInverseConv
from src.structures.sparse_bev import SparseMap

NORM = {"eps": 1e-3, "momentum": 0.1}  # as VoxelNeXt's backbone, with torch's momentum: trainings are short


class SparseNeck(nn.Module):
    """A pyramid of levels at strides 2, 4, ..., each added on the way up to the next finer one (ours).

    What BEVFusion's decoder does on a dense map: with three levels a cell sees some 35 cells to each
    side, long vehicles whole. The sites stay, so the cost follows what is occupied.
    """

    def __init__(
        self,
        channels: int,  # C, of the map
        level_channels: Sequence[int],  # of the levels, the finest (stride 2) first
    ) -> None:
        super().__init__()
        self.down, self.up = nn.ModuleList(), nn.ModuleList()
        for width, coarser in zip((channels, *level_channels), level_channels, strict=False):
            down = ConvNormReLU(SparseConv(width, coarser, 3, 2, bias=False, stride=2), **NORM)
            self.down.append(nn.Sequential(down, ResidualBlock(coarser, 2, **NORM)))
            self.up.append(ConvNormReLU(SparseInverseConv(coarser, width, 3, 2, bias=False, stride=2), **NORM))

    def forward(
        self,
        x: SparseMap,  # [M, C] on (B, y, x)
    ) -> SparseMap:  # [M, C] on the same sites
        levels = [x]
        for down in self.down:
            levels.append(down(levels[-1]))
        y = levels.pop()
        for up in reversed(self.up):
            finer = levels.pop()
            y = finer.with_features(finer.features + up(y, finer.sites).features)
        return y
