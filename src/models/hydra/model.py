"""HyDRa (Wolters et al., 2024): radar in the images before depth, and images asked again by the map (method 13.7)."""

from __future__ import annotations

from dataclasses import dataclass, replace

from torch import Tensor

from src.errors import ConfigError
from src.losses.classification import balanced_focal
from src.models.camera_radar import CameraRadarConfig, CameraRadarDetector, CameraRadarLossConfig, CameraRadarOutput
from src.models.detector import Objective
from src.models.hydra.depth_consistency import DepthConsistency, DepthConsistencyConfig
from src.models.hydra.height_association import HeightLift, HeightLiftConfig
from src.models.hydra.squeeze_fuser import SqueezeFuser
from src.models.layers.feed_forward import NUM_HEADS
from src.models.map_memory import MapMemory, RecalledMaps, TemporalFusion
from src.structures.batch import FrameBatch
from src.targets.box_raster import BoxRaster


@dataclass(kw_only=True)
class HyDRaLossConfig(CameraRadarLossConfig):
    """Weights of the terms (`model.loss`); null switches a term off, uncomputed."""

    foreground_weight: float | None  # of cells


@dataclass(kw_only=True)
class HyDRaConfig(CameraRadarConfig):
    """Settings of the model (`model`). Raises ConfigError for parts that do not go together."""

    view_transform: HeightLiftConfig
    refinement: DepthConsistencyConfig
    loss: HyDRaLossConfig

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.fused_channels % NUM_HEADS:
            raise ConfigError(f"model.fused_channels={self.fused_channels}: must be a multiple of {NUM_HEADS} heads")


@dataclass
class HyDRaOutput(CameraRadarOutput):
    """One frame through the model."""

    foreground_logits: Tensor  # [B, rows, cols] float32
    recalled: RecalledMaps | None  # None in phase 1


class HyDRa(CameraRadarDetector):
    """Height association, lift-splat, squeeze-and-excitation fusion, depth consistency, stacked maps, dense head."""

    memory_type = MapMemory
    latency_parts = CameraRadarDetector.latency_parts | {
        "view_transform": (*CameraRadarDetector.latency_parts["view_transform"], "refinement.forward")
    }

    def build_fusion(self) -> None:
        """Lifting that knows the radar, fusion of both maps, backward projection, and the memory."""
        config, fused, radar = self.config, self.config.fused_channels, self.config.radar_encoder.channels
        lift, encoder = config.view_transform, self.image_encoder
        self.view_transform = HeightLift(lift, encoder.channels, radar, encoder.image_size_px[0], self.grid)
        self.fuser = SqueezeFuser(lift.context_channels + radar, fused)
        self.refinement = DepthConsistency(config.refinement, fused, lift.context_channels, lift.depth_range, self.grid)
        self.temporal = TemporalFusion(config.temporal, fused, self.grid) if config.temporal is not None else None

    def forward(self, batch: FrameBatch, memory: MapMemory | None = None) -> tuple[HyDRaOutput, MapMemory | None]:
        """Detect in the frames of B streams, given what is remembered of them; the new memory is detached.

        Raises ValueError when images are absent or of another number, or when the memory is of other streams.
        """
        views, radar_bev = self.encode(batch, memory)
        lifted = self.view_transform(views, radar_bev)
        fused = self.fuser(lifted.bev, radar_bev)
        context = replace(views, levels=[lifted.context])
        fused, foreground = self.refinement(fused, radar_bev, context, lifted.depth_logits)
        current, recalled, memory_now = fused, None, None
        if self.temporal is not None:
            current, recalled, memory_now = self.temporal(memory, batch, fused)
        head = self.head(self.decoder(current))
        return HyDRaOutput(lifted, radar_bev, fused, head, foreground, recalled), memory_now

    def loss_terms(self, output: HyDRaOutput, batch: FrameBatch) -> Objective:
        """Also `foreground`: which cells lie in boxes."""
        terms, counts = super().loss_terms(output, batch)
        if self.config.loss.foreground_weight is not None:
            raster = BoxRaster(batch.boxes, self.grid, margin_m=0.0, device=batch.device)
            focal = balanced_focal(output.foreground_logits.flatten(), raster.keys)
            terms["foreground"] = self.config.loss.foreground_weight * focal
        return Objective(terms, counts)

    def diagnostics(self, output: HyDRaOutput) -> dict[str, Tensor | float]:
        """Also cells called foreground and past maps in use."""
        frames = len(output.radar_bev)
        values = super().diagnostics(output) | {"foreground_cells": (output.foreground_logits > 0).sum() / frames}
        if output.recalled is not None:
            values["remembered_frames"] = output.recalled.usable.sum() / frames
        return values
