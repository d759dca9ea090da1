"""CRT-Fusion (Kim et al., NeurIPS 2024): camera, radar and time fused on a dense BEV map (method 13.1)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from src.losses.classification import balanced_focal, sigmoid_focal
from src.losses.normalizers import mean_over_ranks
from src.models.camera_radar import CameraRadarConfig, CameraRadarDetector, CameraRadarLossConfig, CameraRadarOutput
from src.models.crt_fusion.motion_estimator import CellMotion, MotionEstimator, velocity_loss
from src.models.crt_fusion.motion_fusion import MotionFusionConfig, MotionGuidedFusion, MovedMaps, StackMemory
from src.models.crt_fusion.radar_lift import RadarLift, RadarLiftConfig
from src.models.detector import Objective
from src.models.layers.dense import DenseConvNormReLU, MapConv2d
from src.structures.batch import FrameBatch
from src.targets.box_raster import BoxRaster


@dataclass(kw_only=True)
class CRTFusionLossConfig(CameraRadarLossConfig):
    """Weights of the terms (`model.loss`); null switches a term off, uncomputed."""

    foreground_weight: float | None  # of pixels
    occupancy_weight: float | None  # of cells
    velocity_weight: float | None  # of cells


@dataclass(kw_only=True)
class CRTFusionConfig(CameraRadarConfig):
    """Settings of the model (`model`). Raises ConfigError for parts that do not go together."""

    view_transform: RadarLiftConfig
    temporal: MotionFusionConfig | None  # null: single frames, phase 1
    loss: CRTFusionLossConfig


@dataclass
class CRTFusionOutput(CameraRadarOutput):
    """One frame through the model."""

    motion: CellMotion
    moved: MovedMaps | None  # None in phase 1


class GatedFuser(nn.Module):
    """Radar-camera gating (CRT-Fusion): both maps by a convolution, added with weights that each cell takes from both.

    The camera map says in one more channel where anything was lifted to.
    """

    def __init__(self, camera_channels: int, radar_channels: int, channels: int) -> None:
        super().__init__()
        self.camera = DenseConvNormReLU(camera_channels + 1, channels, 3)
        self.radar = DenseConvNormReLU(radar_channels, channels, 3)
        self.gates = MapConv2d(channels, 2 * channels, 1)

    def forward(
        self,
        camera: Tensor,  # [B, C_camera, rows, cols], zero where nothing was lifted to
        radar: Tensor,  # [B, C_radar, rows, cols]
    ) -> Tensor:  # [B, C, rows, cols]
        camera = self.camera(torch.cat([camera, (camera != 0).any(1, keepdim=True).to(camera.dtype)], dim=1))
        radar = self.radar(radar)
        for_camera, for_radar = self.gates(camera + radar).sigmoid().chunk(2, dim=1)
        return camera * for_camera + radar * for_radar


class CRTFusion(CameraRadarDetector):
    """Multi-view fusion, motion estimator, motion-guided temporal fusion, decoder and dense head."""

    memory_type = StackMemory
    latency_parts = CameraRadarDetector.latency_parts | {
        "temporal_fusion": ("estimator.forward", *CameraRadarDetector.latency_parts["temporal_fusion"])
    }

    def build_fusion(self) -> None:
        """Radar-guided lifting, gated fusion of both maps, motion estimator, and the memory."""
        config, fused, radar = self.config, self.config.fused_channels, self.config.radar_encoder.channels
        self.view_transform = RadarLift(config.view_transform, self.image_encoder.channels, radar, self.grid)
        self.fuser = GatedFuser(config.view_transform.context_channels, radar, fused)
        self.estimator = MotionEstimator(fused)
        self.temporal = MotionGuidedFusion(config.temporal, fused, self.grid) if config.temporal is not None else None

    def forward(
        self, batch: FrameBatch, memory: StackMemory | None = None
    ) -> tuple[CRTFusionOutput, StackMemory | None]:
        """Detect in the frames of B streams, given what is remembered of them; the new memory is detached.

        Raises ValueError when images are absent or of another number, or when the memory is of other streams.
        """
        views, radar_bev = self.encode(batch, memory)
        lifted = self.view_transform(views, radar_bev)
        current = fused = self.fuser(lifted.bev, radar_bev)
        motion, moved, memory_now = self.estimator(fused), None, None
        if self.temporal is not None:
            moved = self.temporal.recall(memory, batch)
            current = self.temporal.aggregate(fused, moved)
            memory_now = self.temporal.remember(batch, fused, motion, moved)
        head = self.head(self.decoder(current))
        return CRTFusionOutput(lifted, radar_bev, fused, head, motion, moved), memory_now

    def loss_terms(self, output: CRTFusionOutput, batch: FrameBatch) -> Objective:
        """Weighted terms `heatmap`, `box`, `depth`, `foreground`, `occupancy` and `velocity`."""
        weights, (terms, counts) = self.config.loss, super().loss_terms(output, batch)
        if weights.foreground_weight is not None:
            target = self.view_transform.depth_target(batch, self.image_encoder.image_size_px) >= 0  # [B*N, h, w]
            present = batch.image_valid.flatten()[:, None, None].expand_as(target)
            total = (sigmoid_focal(output.lifted.foreground_logits, target) * present).sum()
            terms["foreground"] = weights.foreground_weight * total / mean_over_ranks(present.sum())
        raster = BoxRaster(batch.boxes, self.grid, margin_m=0.0, device=batch.device)
        if weights.occupancy_weight is not None:
            terms["occupancy"] = weights.occupancy_weight * balanced_focal(output.motion.occupancy_logits, raster.keys)
        if weights.velocity_weight is not None:
            terms["velocity"] = weights.velocity_weight * velocity_loss(output.motion, raster)
        return Objective(terms, counts)

    def diagnostics(self, output: CRTFusionOutput) -> dict[str, Tensor | float]:
        """Also cells called occupied and past maps in use."""
        frames = len(output.radar_bev)
        values = super().diagnostics(output) | {"occupied_cells": (output.motion.occupancy_logits > 0).sum() / frames}
        if output.moved is not None:
            values["remembered_frames"] = output.moved.usable.sum() / frames
        return values
