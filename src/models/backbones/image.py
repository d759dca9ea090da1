"""Image encoder: backbone and neck, raw camera bytes in, a feature pyramid out (method 3)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.errors import ConfigError
from src.models.backbones.resnet import BasicBlock, Bottleneck, ResNet
from src.models.backbones.vovnet import VoVNet99
from src.models.backbones.weights import BackboneName, load_backbone_weights
from src.models.layers.dense import Conv2d
from src.models.layers.norm import MapBatchNorm

COARSEST_STRIDE = 32
RESNET50_WIDTHS, RESNET50_BLOCKS = [64, 128, 256, 512], [3, 4, 6, 3]
# ImageNet statistics for RGB scaled to 0..1, here for bytes; Caffe's, for bytes in BGR order (the V2-99 checkpoints).
IMAGENET_MEAN, IMAGENET_STD = (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)
CAFFE_MEAN, CAFFE_STD = (103.53, 116.28, 123.675), (57.375, 57.12, 58.395)


class NeckName(Enum):
    """How the stages become the pyramid; members are spelled as in the configuration."""

    fpn = "fpn"
    secondfpn16 = "secondfpn16"


@dataclass(kw_only=True)
class ImageEncoderConfig:
    """Settings of the image encoder (`backbone` in the configuration).

    Raises ConfigError for sizes that do not fit together.
    """

    name: BackboneName
    image_size_px: list[int]  # network input [H, W], multiples of 32
    weights: str | None  # pretrained file; null = from scratch
    lr_multiplier: float  # on the learning rate of the backbone (not of the neck); read by the optimiser
    neck: NeckName
    neck_channels: int  # C_I, width of every level
    trim_padding: bool  # skip whole black stride-32 rows on top of the images
    widths: list[int] | None  # of `small` only: channels of the four stages
    blocks: list[int] | None  # of `small` only: basic blocks of the four stages

    def __post_init__(self) -> None:
        size = self.image_size_px
        if len(size) != 2 or any(edge < 1 or edge % COARSEST_STRIDE for edge in size):
            raise ConfigError(
                f"backbone.image_size_px={size}: must be [height, width], each a multiple of {COARSEST_STRIDE}, "
                "the backbone's coarsest stride in pixels"
            )
        for key, value in (("widths", self.widths), ("blocks", self.blocks)):
            if self.name is BackboneName.small:
                if value is None or len(value) != 4 or min(value) < 1:
                    raise ConfigError(f"backbone.{key}={value}: backbone.name=small needs four positive numbers")
            elif value is not None:
                raise ConfigError(f"backbone.{key}={value}: must be null, only backbone.name=small reads it")
        if self.neck_channels < 1 or (self.neck is NeckName.secondfpn16 and self.neck_channels % 4):
            raise ConfigError(
                f"backbone.neck_channels={self.neck_channels}: must be positive and, for backbone.neck=secondfpn16, "
                "a multiple of 4, one part per stage"
            )
        if self.lr_multiplier < 0:
            raise ConfigError(f"backbone.lr_multiplier={self.lr_multiplier}: must not be negative")
        if self.name is BackboneName.small and self.weights is not None:
            raise ConfigError(f"backbone.weights={self.weights}: must be null, there are none for backbone.name=small")


class FPN(nn.Module):
    """Feature pyramid at strides 8, 16 and 32: 1x1 laterals, nearest upsampling, 3x3 output convolutions, no norm.

    `strides` may list fewer, in ascending order; laterals that no output level needs are not built.
    """

    offered = (8, 16, 32)

    def __init__(self, in_channels: list[int], channels: int, strides: tuple[int, ...] = offered) -> None:
        super().__init__()
        self.strides = strides
        self.first_stage = 1 + self.offered.index(strides[0])
        self.laterals = nn.ModuleList(Conv2d(width, channels, 1) for width in in_channels[self.first_stage :])
        self.outputs = nn.ModuleList(Conv2d(channels, channels, 3, padding=1) for _ in strides)
        for conv in (*self.laterals, *self.outputs):
            nn.init.xavier_uniform_(conv.weight)
            nn.init.zeros_(conv.bias)

    def forward(
        self,
        stages: list[Tensor],  # four of [M, C_l, H_l, W_l] at strides 4, 8, 16, 32
    ) -> list[Tensor]:  # of each wanted stride [M, channels, H_l, W_l]
        maps = [lateral(stage) for lateral, stage in zip(self.laterals, stages[self.first_stage :], strict=True)]
        for level in reversed(range(len(maps) - 1)):
            maps[level] = maps[level] + F.interpolate(maps[level + 1], size=maps[level].shape[-2:], mode="nearest")
        wanted = [
            x for x, stride in zip(maps, self.offered[self.first_stage - 1 :], strict=True) if stride in self.strides
        ]
        return [conv(x) for conv, x in zip(self.outputs, wanted, strict=True)]


class SecondFPN16(nn.Module):
    """A single map at stride 16: every stage is resampled to it by one (transposed) convolution, then concatenated."""

    offered = (16,)

    def __init__(self, in_channels: list[int], channels: int, strides: tuple[int, ...] = offered) -> None:
        super().__init__()
        part = channels // 4
        at_4, at_8, at_16, at_32 = in_channels
        resample = (
            Conv2d(at_4, part, 4, 4, bias=False),
            Conv2d(at_8, part, 2, 2, bias=False),
            Conv2d(at_16, part, 1, bias=False),
            nn.ConvTranspose2d(at_32, part, 2, 2, bias=False),
        )
        self.branches = nn.ModuleList(
            nn.Sequential(conv, MapBatchNorm(part, eps=1e-3, momentum=0.01), nn.ReLU(inplace=True)) for conv in resample
        )

    def forward(
        self,
        stages: list[Tensor],  # four of [M, C_l, H_l, W_l] at strides 4, 8, 16, 32
    ) -> list[Tensor]:  # one of [M, channels, H / 16, W / 16]
        return [torch.cat([branch(stage) for branch, stage in zip(self.branches, stages, strict=True)], dim=1)]


class ImageEncoder(nn.Module):
    """Backbone and neck over all cameras of all samples (method 3).

    Feature row r of a level with stride s covers pixel rows r * s to (r + 1) * s of the input image, whether or not
    padding is trimmed. `strides` and `channels` describe the output, by default all levels of the neck. Loads
    `config.weights` when given: raises CheckpointError for a file that does not fit, and ConfigError for a stride that
    the neck does not offer.
    """

    def __init__(self, config: ImageEncoderConfig, strides: tuple[int, ...] | None = None) -> None:
        super().__init__()
        self.image_size_px = tuple(config.image_size_px)
        self.trim_padding = config.trim_padding
        self.backbone = build_backbone(config)
        neck = FPN if config.neck is NeckName.fpn else SecondFPN16
        self.channels, self.strides = config.neck_channels, neck.offered if strides is None else strides
        if not set(self.strides) <= set(neck.offered):
            raise ConfigError(
                f"backbone.neck={config.neck.value}: gives levels of stride {list(neck.offered)} px, but the model "
                f"asks for {list(self.strides)}; choose another neck, or another stride in the model"
            )
        self.neck = neck(self.backbone.out_channels, config.neck_channels, self.strides)
        self.reads_bgr = config.name is BackboneName.vovnet99
        mean, std = (CAFFE_MEAN, CAFFE_STD) if self.reads_bgr else (IMAGENET_MEAN, IMAGENET_STD)
        self.register_buffer("mean", torch.tensor(mean).view(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(std).view(3, 1, 1), persistent=False)
        if config.weights is not None:
            load_backbone_weights(self.backbone, config.weights, config.name)
        self.to(memory_format=torch.channels_last)  # measured 1.3 to 3 times faster with bf16

    def forward(
        self,
        images: Tensor,  # [B, N, 3, H, W] uint8 RGB
    ) -> list[Tensor]:  # per stride [B, N, C_I, H_l, W_l]
        """Encode the views. Raises ValueError for images of another size or type than the configured one."""
        if images.dim() != 5 or images.dtype != torch.uint8 or tuple(images.shape[2:]) != (3, *self.image_size_px):
            raise ValueError(
                f"images must be [B, N, 3, {self.image_size_px[0]}, {self.image_size_px[1]}] uint8, "
                f"but got {list(images.shape)} {images.dtype}"
            )
        views = images.flatten(0, 1)  # [B * N, 3, H, W]
        skipped = count_black_rows(views) if self.trim_padding else 0
        maps = self.neck(self.backbone(self.normalise(views[:, :, skipped:])))
        # Zero features stand for the skipped rows, so that pixel coordinates keep their meaning.
        if skipped:
            maps = [F.pad(x, (0, 0, skipped // stride, 0)) for x, stride in zip(maps, self.strides, strict=True)]
        return [x.unflatten(0, images.shape[:2]) for x in maps]

    def normalise(
        self,
        views: Tensor,  # [M, 3, H, W] uint8 RGB
    ) -> Tensor:  # [M, 3, H, W] float32, channels last
        """Bytes to the statistics and channel order that the backbone was trained with."""
        values = (views.flip(1) if self.reads_bgr else views).to(self.mean.dtype)
        return ((values - self.mean) / self.std).contiguous(memory_format=torch.channels_last)


def build_backbone(config: ImageEncoderConfig) -> ResNet | VoVNet99:
    """The backbone named by `config.name`, from scratch."""
    if config.name is BackboneName.vovnet99:
        return VoVNet99()
    if config.name is BackboneName.resnet50:
        return ResNet(Bottleneck, RESNET50_WIDTHS, RESNET50_BLOCKS)
    return ResNet(BasicBlock, config.widths, config.blocks)


def count_black_rows(
    views: Tensor,  # [M, 3, H, W] uint8
) -> int:
    """Rows on top that are black in every view, as a whole number of stride-32 rows; at least one of those is kept.

    640 x 960 holds 183 padded rows at the test-time resize of a 1980 x 943 camera: 160 are skipped, 480 x 960 remain.
    Training resizes move that edge, so it is read off the images; a batch keeps what its fullest view needs.
    """
    height = views.shape[2]
    lit = views.amax(dim=(0, 1, 3)).nonzero()[:, 0]  # rows with any light
    first = int(lit[0]) if len(lit) else height
    return min(first // COARSEST_STRIDE, height // COARSEST_STRIDE - 1) * COARSEST_STRIDE
