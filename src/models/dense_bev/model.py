"""Dense baseline: radar-camera fusion on a whole BEV map, in the way of BEVFusion (method 13)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from src.models.camera_radar import CameraRadarConfig, CameraRadarDetector, CameraRadarOutput
from src.models.layers.dense import DenseConvNormReLU
from src.models.layers.lift_splat import LiftSplat
from src.models.map_memory import MapMemory, RecalledMaps, TemporalFusion
from src.structures.batch import FrameBatch


@dataclass(kw_only=True)
class DenseBEVConfig(CameraRadarConfig):
    """Settings of the model (`model`)."""


@dataclass
class DenseBEVOutput(CameraRadarOutput):
    """One frame through the model."""

    recalled: RecalledMaps | None  # None in phase 1


class ConvFuser(nn.Module):
    """Camera and radar map side by side through one 3x3 convolution."""

    def __init__(self, in_channels: int, channels: int) -> None:
        super().__init__()
        self.conv = DenseConvNormReLU(in_channels, channels, 3)

    def forward(
        self,
        camera: Tensor,  # [B, C_camera, rows, cols]
        radar: Tensor,  # [B, C_radar, rows, cols]
    ) -> Tensor:  # [B, C, rows, cols]
        if torch.is_autocast_enabled(camera.device.type):  # before they are joined: half the bytes
            half = torch.get_autocast_dtype(camera.device.type)
            camera, radar = camera.to(half), radar.to(half)
        return self.conv(torch.cat([camera, radar], dim=1))


class DenseBEV(CameraRadarDetector):
    """BEVFusion-style detector: lift-splat and pillars onto one dense map, a convolutional decoder, a dense head."""

    memory_type = MapMemory

    def build_fusion(self) -> None:
        """Lift-splat, one convolution of both maps, and the memory."""
        config = self.config
        self.view_transform = LiftSplat(config.view_transform, self.image_encoder.channels, self.grid)
        both = config.view_transform.context_channels + config.radar_encoder.channels
        self.fuser = ConvFuser(both, config.fused_channels)
        self.temporal = (
            TemporalFusion(config.temporal, config.fused_channels, self.grid) if config.temporal is not None else None
        )

    def forward(self, batch: FrameBatch, memory: MapMemory | None = None) -> tuple[DenseBEVOutput, MapMemory | None]:
        """Detect in the frames of B streams, given what is remembered of them; the new memory is detached.

        Raises ValueError when images are absent or of another number, or when the memory is of other streams.
        """
        views, radar_bev = self.encode(batch, memory)
        lifted = self.view_transform(views)
        fused = self.fuser(lifted.bev, radar_bev)
        current, recalled, memory_now = fused, None, None
        if self.temporal is not None:
            current, recalled, memory_now = self.temporal(memory, batch, fused)
        return DenseBEVOutput(lifted, radar_bev, fused, self.head(self.decoder(current)), recalled), memory_now

    def diagnostics(self, output: DenseBEVOutput) -> dict[str, Tensor | float]:
        """Also past maps in use."""
        values = super().diagnostics(output)
        if output.recalled is not None:
            values["remembered_frames"] = output.recalled.usable.sum() / len(output.radar_bev)
        return values
