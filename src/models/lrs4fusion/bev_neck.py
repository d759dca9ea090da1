"""From the volume to the map that the detection head reads: maximum over height, SECOND and its FPN (lrs 5.9)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.errors import ConfigError, require_least
from src.models.layers.dense import DenseConvNormReLU
from src.models.layers.norm import MapBatchNorm
from src.models.lrs4fusion.late_encoder import NUM_SCALES
from src.ops.segment_reduce import segment_max
from src.ops.sites import Sites
from src.structures.sparse_bev import SparseBEV, SparseMap


@dataclass(kw_only=True)
class BEVNeckConfig:
    """Settings of the neck (`model.neck`). Raises ConfigError for lists that do not fit together."""

    finest_scale: int  # of V1 .. V4 that it reads, and whose cells the map has; coarser ones are repeated beside it
    stage_channels: list[int]
    stage_strides: list[int]
    layers_per_stage: int  # after the strided one
    fpn_channels: int  # of every stage, at the resolution of the map

    def __post_init__(self) -> None:
        if not self.stage_channels or len(self.stage_channels) != len(self.stage_strides):
            raise ConfigError(
                f"model.neck.stage_channels={self.stage_channels} and model.neck.stage_strides={self.stage_strides}: "
                "must be of the same length, one value a stage"
            )
        require_least(self, "model.neck", {"layers_per_stage": 0, "fpn_channels": 1})
        if not 1 <= self.finest_scale <= NUM_SCALES:
            raise ConfigError(f"model.neck.finest_scale={self.finest_scale}: must be 1 to {NUM_SCALES}, a scale of V")


class BEVNeck(nn.Module):
    """Scales of a sparse volume to a dense map of their columns, as wide as all stages' FPN channels together."""

    def __init__(self, config: BEVNeckConfig, scale_channels: Sequence[int]) -> None:
        super().__init__()
        self.level = config.finest_scale - 1
        self.stages, self.ups = nn.ModuleList(), nn.ModuleList()
        width, stride = sum(scale_channels[self.level :]), 1
        for channels, step in zip(config.stage_channels, config.stage_strides, strict=True):
            rest = (DenseConvNormReLU(channels, channels, 3) for _ in range(config.layers_per_stage))
            self.stages.append(nn.Sequential(DenseConvNormReLU(width, channels, 3, step), *rest))
            width, stride = channels, stride * step
            self.ups.append(UpConvNormReLU(channels, config.fpn_channels, stride))
        self.out_channels = config.fpn_channels * len(self.ups)

    def forward(
        self,
        scales: Sequence[SparseMap],  # all, the finest first, on (B, z, y, x)
    ) -> Tensor:  # [B, out_channels, rows, cols]
        maps = [columns(volume).to_dense() for volume in scales[self.level :]]
        size, outputs = maps[0].shape[-2:], []
        repeated = (F.interpolate(x, scale_factor=2**power) for power, x in enumerate(maps) if power)
        x = torch.cat([maps[0], *(x[..., : size[0], : size[1]] for x in repeated)], dim=1)
        for stage, up in zip(self.stages, self.ups, strict=True):
            x = stage(x)
            outputs.append(up(x)[..., : size[0], : size[1]])  # a stride may have rounded the size up
        return torch.cat(outputs, dim=1)


class UpConvNormReLU(nn.Module):
    """A transposed convolution whose kernel is its stride, batch norm and ReLU."""

    norm_pairs = (("conv", "norm"),)

    def __init__(self, in_channels: int, out_channels: int, stride: int) -> None:
        super().__init__()
        self.conv = nn.ConvTranspose2d(in_channels, out_channels, stride, stride, bias=False)
        self.norm = MapBatchNorm(out_channels)

    def forward(
        self,
        x: Tensor,  # [B, C, H, W]
    ) -> Tensor:  # [B, C', H stride, W stride]
        return F.relu(self.norm(self.conv(x)), inplace=True)


def columns(volume: SparseMap) -> SparseBEV:
    """The maximum over height of every column that has a site."""
    batch_size, _, rows, cols = volume.sites.shape
    sites, owners = Sites.unique(volume.indices[:, [0, 2, 3]], (batch_size, rows, cols))
    return SparseBEV(sites, segment_max(volume.features, owners, len(sites)))
