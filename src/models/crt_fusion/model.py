"""CRT-Fusion (Kim et al., NeurIPS 2024): camera, radar and time fused on a dense BEV map (method 13.1)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from src.errors import ConfigError, require_least
from src.geometry.bev_grid import BEVGrid
from src.losses.classification import depth_cross_entropy, sigmoid_focal
from src.losses.loss_weights import LossWeights
from src.losses.normalizers import mean_over_ranks
from src.models.backbones.bev_decoder import MIN_CHANNELS, BEVDecoder, BEVDecoderConfig, GatedFuser
from src.models.backbones.image import ImageEncoder, ImageEncoderConfig
from src.models.backbones.pillars import PillarConfig, PillarEncoder
from src.models.crt_fusion.motion_estimator import CellMotion, MotionEstimator, occupancy_loss, velocity_loss
from src.models.crt_fusion.radar_lift import RadarLift, RadarLiftConfig, RadarLiftedViews
from src.models.detector import Detector, ModelConfig, Objective
from src.models.heads.center_head import BoxOptions, CenterHead, HeadConfig, HeadOutput
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from src.targets.box_raster import BoxRaster


@dataclass(kw_only=True)
class CRTFusionLossConfig(LossWeights):
    """Weights of the terms (`model.loss`); null switches a term off, uncomputed."""

    heatmap_weight: float | None
    box_weight: float | None
    depth_weight: float | None
    foreground_weight: float | None  # of pixels
    occupancy_weight: float | None  # of cells
    velocity_weight: float | None  # of cells


@dataclass(kw_only=True)
class CRTFusionConfig(ModelConfig):
    """Settings of the model (`model`). Raises ConfigError for parts that do not go together."""

    fused_channels: int  # width of the fused map
    radar_encoder: PillarConfig
    view_transform: RadarLiftConfig
    decoder: BEVDecoderConfig
    head: HeadConfig
    loss: CRTFusionLossConfig

    def __post_init__(self) -> None:
        require_least(self, "model", {"channels": 1, "fused_channels": MIN_CHANNELS})

    @property
    def sensors(self) -> tuple[str, ...]:
        """Both always: without cameras there is nothing to fuse."""
        return ("camera", "radar")


@dataclass
class CRTFusionOutput:
    """One frame through the model."""

    views: RadarLiftedViews
    radar_bev: Tensor  # [B, C_radar, rows, cols]
    fused_bev: Tensor  # [B, C_fused, rows, cols]
    motion: CellMotion
    head: HeadOutput


class CRTFusion(Detector):
    """Multi-view fusion, motion estimator, decoder and dense head.

    Raises ConfigError when parts, grid and backbone do not fit.
    """

    phase_options = BoxOptions
    latency_parts = {
        "image_encoder": ("image_encoder.forward",),
        "radar_encoder": ("radar_encoder.forward",),
        "view_transform": ("view_transform.forward", "fuser.forward"),
        # The way from the fused map to the head, as of the dense baseline.
        "temporal_fusion": ("estimator.forward", "decoder.forward"),
        "detection_head": ("head.forward", "head.decode"),
    }

    def __init__(
        self,
        config: CRTFusionConfig,
        grid: BEVGrid,
        backbone: ImageEncoderConfig | None,
        options: BoxOptions,
    ) -> None:
        super().__init__()
        if backbone is None:
            raise ConfigError("backbone=null: model=crt_fusion fuses radar with images; choose a backbone")
        self.config, self.grid = config, grid
        radar, lift, fused = config.radar_encoder, config.view_transform, config.fused_channels
        self.image_encoder = ImageEncoder(backbone, strides=(lift.image_stride_px,))
        self.radar_encoder = PillarEncoder(radar, grid)
        self.view_transform = RadarLift(lift, self.image_encoder.channels, radar.channels, grid)
        self.fuser = GatedFuser(lift.context_channels, radar.channels, fused)
        self.estimator = MotionEstimator(fused)
        self.decoder = BEVDecoder(config.decoder, fused, config.channels, grid)
        self.head = CenterHead(config.head, config.channels, grid, options.velocity_code_weight, dense=True)
        self.to(memory_format=torch.channels_last)

    @property
    def image_backbone(self) -> nn.Module:
        """Backbone without its neck."""
        return self.image_encoder.backbone

    def forward(self, batch: FrameBatch, memory: None = None) -> tuple[CRTFusionOutput, None]:
        """Detect in B frames. Raises ValueError when images are absent."""
        if batch.images is None or batch.image_valid is None or batch.pix_from_aug is None:
            raise ValueError("FrameBatch.images is None, but this model uses images; read them with the frames")
        (level,) = self.image_encoder(batch.images)
        radar_bev = self.radar_encoder(batch.radar_points, batch.radar_batch, len(batch))
        cameras = (batch.pix_from_aug, batch.image_valid, self.image_encoder.image_size_px)
        views = self.view_transform(level, radar_bev, *cameras)
        fused = self.fuser(views.bev, radar_bev)
        motion = self.estimator(fused)
        return CRTFusionOutput(views, radar_bev, fused, motion, self.head(self.decoder(fused))), None

    def loss_terms(self, output: CRTFusionOutput, batch: FrameBatch) -> Objective:
        """Weighted terms `heatmap`, `box`, `depth`, `foreground`, `occupancy` and `velocity`."""
        weights, views = self.config.loss, output.views
        terms, counts = self.head.loss(output.head, batch.boxes, weights.heatmap_weight, weights.box_weight)
        depth = self.view_transform.depth_target(batch, self.image_encoder.image_size_px)  # [B*N, h, w]
        if weights.depth_weight is not None:
            total = depth_cross_entropy(views.depth_logits.flatten(0, 1), depth)
            terms["depth"] = weights.depth_weight * total / mean_over_ranks((depth >= 0).sum())
        if weights.foreground_weight is not None:
            present = batch.image_valid.flatten()[:, None, None].expand_as(depth)
            total = (sigmoid_focal(views.foreground_logits, depth >= 0) * present).sum()
            terms["foreground"] = weights.foreground_weight * total / mean_over_ranks(present.sum())
        raster = BoxRaster(batch.boxes, self.grid, margin_m=0.0)
        if weights.occupancy_weight is not None:
            terms["occupancy"] = weights.occupancy_weight * occupancy_loss(output.motion, raster)
        if weights.velocity_weight is not None:
            terms["velocity"] = weights.velocity_weight * velocity_loss(output.motion, raster)
        return Objective(terms, counts)

    def decode(self, output: CRTFusionOutput) -> list[Boxes3D]:
        """Boxes of each frame, best first."""
        return self.head.decode(output.head)

    def diagnostics(self, output: CRTFusionOutput) -> dict[str, Tensor | float]:
        """Pillars, lifted pairs and occupied cells per frame, and how sure depth is."""
        frames = len(output.radar_bev)
        return {
            "pillars": output.radar_bev.any(dim=1).sum() / frames,
            "lifted_pairs": output.views.num_lifted / frames,
            "depth_confidence": output.views.depth_logits.float().softmax(2).amax(2).mean(),
            "occupied_cells": (output.motion.occupancy_logits > 0).sum() / frames,
        }
