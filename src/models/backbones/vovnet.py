"""VoVNet V2-99-eSE, the image encoder of the FCOS3D and DD3D checkpoints (method 3)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.models.layers.dense import Conv2d
from src.models.layers.norm import MapBatchNorm

STEM_CHANNELS = (64, 64, 128)
MID_CHANNELS = (128, 160, 192, 224)
OUT_CHANNELS = (256, 512, 768, 1024)
BLOCKS = (1, 3, 9, 3)
CONVS_PER_BLOCK = 5


class ImageConvNormReLU(nn.Module):
    """Convolution without bias, batch norm, ReLU; keeps the resolution at stride 1."""

    norm_pairs = (("conv", "bn"),)

    def __init__(self, in_channels: int, out_channels: int, kernel_size: int, stride: int = 1) -> None:
        super().__init__()
        self.conv = Conv2d(in_channels, out_channels, kernel_size, stride, kernel_size // 2, bias=False)
        self.bn = MapBatchNorm(out_channels)

    def forward(
        self,
        x: Tensor,  # [M, C, H, W]
    ) -> Tensor:
        return F.relu(self.bn(self.conv(x)))


class EffectiveSE(nn.Module):
    """Effective squeeze and excitation: one 1x1 convolution of the global mean gates the channels."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.fc = Conv2d(channels, channels, 1)

    def forward(
        self,
        x: Tensor,  # [M, C, H, W]
    ) -> Tensor:
        return x * F.hardsigmoid(self.fc(x.mean((2, 3), keepdim=True)))


class OSAModule(nn.Module):
    """One-shot aggregation: input and outputs of five 3x3 convolutions in a row are concatenated once and reduced."""

    def __init__(self, in_channels: int, mid_channels: int, out_channels: int, identity: bool) -> None:
        super().__init__()
        widths = [in_channels] + [mid_channels] * CONVS_PER_BLOCK
        self.conv_mid = nn.ModuleList(ImageConvNormReLU(a, mid_channels, 3) for a in widths[:-1])
        self.conv_concat = ImageConvNormReLU(sum(widths), out_channels, 1)
        self.attn = EffectiveSE(out_channels)
        self.identity = identity

    def forward(
        self,
        x: Tensor,  # [M, C, H, W]
    ) -> Tensor:  # [M, out_channels, H, W]
        parts = [x]
        for conv in self.conv_mid:
            parts.append(conv(parts[-1]))
        y = self.attn(self.conv_concat(torch.cat(parts, dim=1)))
        return y + x if self.identity else y


class Stage(nn.Module):
    """OSA modules at one resolution; every stage but the first halves it before."""

    def __init__(self, in_channels: int, mid_channels: int, out_channels: int, blocks: int, pool: bool) -> None:
        super().__init__()
        # No padding with ceil mode, unlike ResNet's pooling: sizes and values at the border follow the checkpoints.
        self.pool = nn.MaxPool2d(3, 2, ceil_mode=True) if pool else nn.Identity()
        self.blocks = nn.Sequential(
            *(
                OSAModule(in_channels if index == 0 else out_channels, mid_channels, out_channels, index > 0)
                for index in range(blocks)
            )
        )

    def forward(
        self,
        x: Tensor,  # [M, C, H, W]
    ) -> Tensor:
        return self.blocks(self.pool(x))


class VoVNet99(nn.Module):
    """V2-99-eSE: stages at strides 4, 8, 16 and 32; its input is BGR with Caffe statistics.

    Batch norm always uses its running statistics, also in training; scale and shift are learned (method 3).
    """

    def __init__(self) -> None:
        super().__init__()
        stem_inputs = (3, *STEM_CHANNELS[:-1])
        self.stem = nn.Sequential(
            *(ImageConvNormReLU(a, b, 3, s) for a, b, s in zip(stem_inputs, STEM_CHANNELS, (2, 1, 2), strict=True))
        )
        inputs = (STEM_CHANNELS[-1], *OUT_CHANNELS[:-1])
        self.stages = nn.Sequential(
            *(
                Stage(*sizes, pool=index > 0)
                for index, sizes in enumerate(zip(inputs, MID_CHANNELS, OUT_CHANNELS, BLOCKS, strict=True))
            )
        )
        self.out_channels = list(OUT_CHANNELS)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)

    def train(self, mode: bool = True) -> VoVNet99:
        """Set the mode of all modules but batch norms, which stay in evaluation mode."""
        super().train(mode)
        for module in self.modules():
            if isinstance(module, MapBatchNorm):
                module.eval()
        return self

    def forward(
        self,
        x: Tensor,  # [M, 3, H, W] normalised BGR
    ) -> list[Tensor]:  # four of [M, C_l, H_l, W_l] at strides 4, 8, 16, 32
        x = self.stem(x)
        outputs = []
        for stage in self.stages:
            x = stage(x)
            outputs.append(x)
        return outputs
