"""Residual networks with the parameter names of the published weights (torchvision, timm)."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

from src.models.layers.dense import Conv2d
from src.models.layers.merging import with_relu
from src.models.layers.norm import MapBatchNorm


class BasicBlock(nn.Module):
    """Two 3x3 convolutions around an identity (He et al. 2016, Fig. 5 left)."""

    expansion = 1
    norm_pairs = (("conv1", "bn1"), ("conv2", "bn2"))

    def __init__(self, in_channels: int, width: int, stride: int, conv: type[nn.Conv2d] = Conv2d) -> None:
        super().__init__()
        self.conv1 = conv(in_channels, width, 3, stride, 1, bias=False)
        self.bn1 = MapBatchNorm(width)
        self.conv2 = conv(width, width, 3, 1, 1, bias=False)
        self.bn2 = MapBatchNorm(width)
        self.downsample = _projection(in_channels, width, stride, conv)
        self.merged = False

    def merge_for_inference(self) -> None:
        """The convolutions apply the ReLUs and add the identity."""
        self.conv1, self.conv2, self.merged = with_relu(self.conv1), with_relu(self.conv2), True

    def forward(
        self,
        x: Tensor,  # [M, C, H, W]
    ) -> Tensor:  # [M, width, H / stride, W / stride]
        if self.merged:
            return self.conv2(self.conv1(x), self.downsample(x))
        y = F.relu(self.bn1(self.conv1(x)))
        y = self.bn2(self.conv2(y))
        return F.relu(y + self.downsample(x))


class Bottleneck(nn.Module):
    """1x1, 3x3, 1x1 convolutions around an identity; the 3x3 one carries the stride, as in the published weights."""

    expansion = 4
    norm_pairs = (("conv1", "bn1"), ("conv2", "bn2"), ("conv3", "bn3"))

    def __init__(self, in_channels: int, width: int, stride: int) -> None:
        super().__init__()
        out_channels = width * self.expansion
        self.conv1 = Conv2d(in_channels, width, 1, bias=False)
        self.bn1 = MapBatchNorm(width)
        self.conv2 = Conv2d(width, width, 3, stride, 1, bias=False)
        self.bn2 = MapBatchNorm(width)
        self.conv3 = Conv2d(width, out_channels, 1, bias=False)
        self.bn3 = MapBatchNorm(out_channels)
        self.downsample = _projection(in_channels, out_channels, stride)
        self.merged = False

    def merge_for_inference(self) -> None:
        """The convolutions apply the ReLUs and add the identity."""
        for name in ("conv1", "conv2", "conv3"):
            setattr(self, name, with_relu(getattr(self, name)))
        self.merged = True

    def forward(
        self,
        x: Tensor,  # [M, C, H, W]
    ) -> Tensor:  # [M, 4 * width, H / stride, W / stride]
        if self.merged:
            return self.conv3(self.conv2(self.conv1(x)), self.downsample(x))
        y = F.relu(self.bn1(self.conv1(x)))
        y = F.relu(self.bn2(self.conv2(y)))
        y = self.bn3(self.conv3(y))
        return F.relu(y + self.downsample(x))


def _projection(in_channels: int, out_channels: int, stride: int, conv: type[nn.Conv2d] = Conv2d) -> nn.Module:
    if stride == 1 and in_channels == out_channels:
        return nn.Identity()
    return nn.Sequential(
        conv(in_channels, out_channels, 1, stride, bias=False),
        MapBatchNorm(out_channels),
    )


class ResNet(nn.Module):
    """Four stages at strides 4, 8, 16 and 32 behind a 7x7 stem; no classifier (method 3).

    `widths` and `blocks` state the inner width and the number of blocks of each stage; ResNet-50 is
    `ResNet(Bottleneck, [64, 128, 256, 512], [3, 4, 6, 3])`.
    """

    norm_pairs = (("conv1", "bn1"),)

    def __init__(self, block: type[BasicBlock] | type[Bottleneck], widths: list[int], blocks: list[int]) -> None:
        super().__init__()
        self.conv1 = Conv2d(3, widths[0], 7, 2, 3, bias=False)
        self.bn1 = MapBatchNorm(widths[0])
        self.maxpool = nn.MaxPool2d(3, 2, 1)
        channels = widths[0]
        for stage, (width, count) in enumerate(zip(widths, blocks, strict=True)):
            layers = []
            for index in range(count):
                layers.append(block(channels, width, stride=2 if stage > 0 and index == 0 else 1))
                channels = width * block.expansion
            self.add_module(f"layer{stage + 1}", nn.Sequential(*layers))
        self.out_channels = [width * block.expansion for width in widths]
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def stem(
        self,
        x: Tensor,  # [M, 3, H, W] normalised RGB
    ) -> Tensor:  # [M, widths[0], H / 2, W / 2]
        """The first convolution, before the pooling."""
        return F.relu(self.bn1(self.conv1(x)))

    def forward(
        self,
        x: Tensor,  # [M, 3, H, W] normalised RGB
    ) -> list[Tensor]:  # four of [M, C_l, H_l, W_l] at strides 4, 8, 16, 32
        x = self.maxpool(self.stem(x))
        outputs = []
        for layer in (self.layer1, self.layer2, self.layer3, self.layer4):
            x = layer(x)
            outputs.append(x)
        return outputs
