"""The dense BEV trunk: residual stages, and a neck back to full resolution (method 13)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.errors import ConfigError, require_least
from src.geometry.bev_grid import BEVGrid
from src.models.backbones.resnet import BasicBlock
from src.models.layers.dense import DenseConvNormReLU, MapConv2d
from src.ops.map_conv import map_conv2d

MIN_CHANNELS = 16
"""Least width of what a strided stage reads: below it the backward pass of a strided 1x1 convolution with channels last
writes beyond its memory on CPUs (oneDNN in torch 2.13; the process dies or computes nonsense)."""


@dataclass(kw_only=True)
class BEVDecoderConfig:
    """Settings of the decoder (`model.decoder`). Raises ConfigError for lists that do not fit together."""

    stage_channels: list[int]  # width of every stage
    stage_strides: list[int]  # of its first block
    blocks_per_stage: int  # basic residual blocks

    def __post_init__(self) -> None:
        if not self.stage_channels or len(self.stage_channels) != len(self.stage_strides):
            raise ConfigError(
                f"model.decoder.stage_channels={self.stage_channels} and model.decoder.stage_strides="
                f"{self.stage_strides}: must be of the same length, one value a stage"
            )
        for name, least in (("stage_channels", MIN_CHANNELS), ("stage_strides", 1)):
            if min(getattr(self, name)) < least:
                raise ConfigError(f"model.decoder.{name}={getattr(self, name)}: each must be at least {least}")
        require_least(self, "model.decoder", {"blocks_per_stage": 1})


class BEVDecoder(nn.Module):
    """Residual stages at ever coarser strides; the first and the last are joined and brought back to every cell.

    Structure of the public BEVFusion decoder, with one more link: the fused map itself joins at full resolution, where
    radar is sharpest.
    """

    def __init__(self, config: BEVDecoderConfig, in_channels: int, channels: int, grid: BEVGrid) -> None:
        super().__init__()
        coarsest = math.prod(config.stage_strides)
        if any(cells % coarsest for cells in grid.cells):
            raise ConfigError(
                f"grid.cells={list(grid.cells)}: each must be a multiple of {coarsest}, the product of "
                f"model.decoder.stage_strides={config.stage_strides}"
            )
        widths = [in_channels, *config.stage_channels]
        self.stages = nn.ModuleList(
            nn.Sequential(
                BasicBlock(widths[stage], width, stride, MapConv2d),
                *(BasicBlock(width, width, 1, MapConv2d) for _ in range(config.blocks_per_stage - 1)),
            )
            for stage, (width, stride) in enumerate(zip(widths[1:], config.stage_strides, strict=True))
        )
        joined = widths[1] + (widths[-1] if len(config.stage_channels) > 1 else 0)
        self.join = nn.Sequential(DenseConvNormReLU(joined, channels, 1), DenseConvNormReLU(channels, channels, 3))
        self.lateral = MapConv2d(in_channels, channels, 1)
        self.output = DenseConvNormReLU(channels, channels, 3)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
        nn.init.zeros_(self.lateral.bias)

    def forward(
        self,
        fused: Tensor,  # [B, C_fused, rows, cols]
    ) -> Tensor:  # [B, C, rows, cols]
        outputs, x = [], fused
        for stage in self.stages:
            x = stage(x)
            outputs.append(x)
        joined = self._join(outputs[0], x) if len(outputs) > 1 else self.join(outputs[0])
        return self.output(self.lateral(fused) + _resized(joined, fused.shape[-2:]))

    def _join(
        self,
        finest: Tensor,  # [B, C_1, h, w]
        coarsest: Tensor,  # [B, C_n, h', w']
    ) -> Tensor:  # [B, C, h, w]
        """`join` of both side by side, the coarsest brought to (h, w).

        A convolution of single cells and interpolation may change places: fewer channels are interpolated.
        """
        mixing, smoothing = self.join
        own, other = mixing.conv.weight.split([finest.shape[1], coarsest.shape[1]], dim=1)
        mixed = map_conv2d(finest, own, mixing.conv.bias) + _resized(map_conv2d(coarsest, other), finest.shape[-2:])
        return smoothing(F.relu(mixing.norm(mixed), inplace=True))


def _resized(
    x: Tensor,  # [B, C, h, w]
    size: torch.Size,
) -> Tensor:  # [B, C, *size]
    if x.shape[-2:] == size:
        return x
    return F.interpolate(x, size=size, mode="bilinear", align_corners=False)
