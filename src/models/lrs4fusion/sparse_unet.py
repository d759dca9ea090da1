"""The sparse U-Net on LiDAR voxels: down by strided convolutions, back up by their inverse to the same sites (lrs 5.1).

The layout of the triples is that of PartA2's public SparseUNet.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from src.errors import ConfigError
from src.models.layers.sparse import ConvNormReLU, ResidualBlock, SparseConv, SparseInverseConv, SubmanifoldConv
from src.structures.sparse_bev import SparseMap


class SparseUNet(nn.Module):
    """Voxels of the finest level to features on the same sites.

    Level l of the encoder has the widths `encoder_channels[l]`; every level but the first begins with a convolution of
    stride 2. The decoder is listed from the coarsest level up; its triple is (lateral, merged, upsampled).
    Raises ConfigError for widths that do not fit together.
    """

    def __init__(
        self,
        in_channels: int,
        encoder_channels: Sequence[Sequence[int]],
        decoder_channels: Sequence[Sequence[int]],
        eps: float,
        momentum: float,
    ) -> None:
        super().__init__()
        _check_widths(encoder_channels, decoder_channels)
        norm = {"eps": eps, "momentum": momentum}
        width = encoder_channels[0][0]
        self.conv_input = ConvNormReLU(SubmanifoldConv(in_channels, width, 3, 3, bias=False), **norm)
        self.encoder = nn.ModuleList()
        for level, widths in enumerate(encoder_channels):
            layers: list[nn.Module] = []
            for number, out in enumerate(widths):
                if level and number == 0:
                    conv = SparseConv(width, out, 3, 3, bias=False, stride=2)
                else:
                    conv = SubmanifoldConv(width, out, 3, 3, bias=False)
                layers.append(ConvNormReLU(conv, **norm))
                width = out
            self.encoder.append(nn.Sequential(*layers))
        self.decoder = nn.ModuleList(
            DecoderLevel(*widths, upsamples=number < len(decoder_channels) - 1, **norm)
            for number, widths in enumerate(decoder_channels)
        )
        self.out_channels = decoder_channels[-1][2]

    def forward(
        self,
        x: SparseMap,  # on (B, z, y, x)
    ) -> SparseMap:
        x = self.conv_input(x)
        levels = []
        for stage in self.encoder:
            x = stage(x)
            levels.append(x)
        finer = [None, *levels[:-1]]
        for level in self.decoder:
            x = level(x, levels.pop(), finer.pop())
        return x


class DecoderLevel(nn.Module):
    """A lateral residual block, a merging convolution with a residual, and the way up to the next finer level."""

    def __init__(self, lateral: int, merged: int, upsampled: int, upsamples: bool, eps: float, momentum: float) -> None:
        super().__init__()
        norm = {"eps": eps, "momentum": momentum}
        self.merged = merged
        self.lateral = ResidualBlock(lateral, 3, **norm)
        self.merge = ConvNormReLU(SubmanifoldConv(2 * lateral, merged, 3, 3, bias=False), **norm)
        if upsamples:
            up = SparseInverseConv(merged, upsampled, 3, 3, bias=False, stride=2)
        else:
            up = SubmanifoldConv(merged, upsampled, 3, 3, bias=False)
        self.up = ConvNormReLU(up, **norm)

    def forward(
        self,
        bottom: SparseMap,  # what came up, on this level's sites
        encoded: SparseMap,  # the encoder's output on the same sites
        finer: SparseMap | None,  # the encoder's output a level finer; None at the finest
    ) -> SparseMap:
        lateral = self.lateral(encoded)
        both = lateral.with_features(torch.cat([bottom.features, lateral.features], dim=1))
        merged = self.merge(both).features + _summed(both.features, self.merged)
        return self.up(both.with_features(merged), *([] if finer is None else [finer.sites]))


def _summed(
    features: Tensor,  # [M, n C]
    channels: int,  # C
) -> Tensor:  # [M, C]
    """Sums of neighbouring channels."""
    return features.unflatten(1, (channels, -1)).sum(2)


def _check_widths(encoder: Sequence[Sequence[int]], decoder: Sequence[Sequence[int]]) -> None:
    key = "model.unet"
    if not encoder or any(not widths or min(widths) < 1 for widths in encoder):
        raise ConfigError(f"{key}.encoder_channels={encoder}: must list at least one positive width for each level")
    if len(decoder) != len(encoder) or any(len(widths) != 3 or min(widths) < 1 for widths in decoder):
        raise ConfigError(
            f"{key}.decoder_channels={decoder}: must list three positive widths for each of the {len(encoder)} levels "
            "of encoder_channels, the coarsest first"
        )
    bottom = encoder[-1][-1]
    for number, (lateral, merged, upsampled) in enumerate(decoder):
        encoded = encoder[-1 - number][-1]
        if not lateral == bottom == encoded or 2 * lateral % merged:
            raise ConfigError(
                f"{key}.decoder_channels={decoder}: entry {number} begins with {lateral}, but must with the width "
                f"{encoded} of its encoder level and {bottom} of what comes up, and its second must divide twice that"
            )
        bottom = upsampled
