"""What detectors that fuse camera and radar on one dense BEV map have in common (method 13)."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from src.errors import ConfigError, require_least
from src.geometry.bev_grid import BEVGrid
from src.losses.classification import depth_cross_entropy
from src.losses.loss_weights import LossWeights
from src.losses.normalizers import mean_over_ranks
from src.models.backbones.bev_decoder import MIN_CHANNELS, BEVDecoder, BEVDecoderConfig
from src.models.backbones.image import ImageEncoder, ImageEncoderConfig
from src.models.backbones.pillars import PillarConfig, PillarEncoder
from src.models.detector import Detector, ModelConfig, Objective
from src.models.heads.center_head import BoxOptions, CenterHead, HeadConfig, HeadOutput
from src.models.layers.lift_splat import LiftedViews, LiftSplatConfig
from src.models.layers.views import CameraViews
from src.models.memory import FrameMemory, TemporalConfig
from src.structures.batch import FrameBatch


@dataclass(kw_only=True)
class CameraRadarLossConfig(LossWeights):
    """Weights of the terms (`model.loss`); null switches a term off, uncomputed."""

    heatmap_weight: float | None
    box_weight: float | None
    depth_weight: float | None


@dataclass(kw_only=True)
class CameraRadarConfig(ModelConfig):
    """Settings of the model (`model`). Raises ConfigError for parts that do not go together."""

    temporal_part: ClassVar[str] = "temporal"
    new_in_temporal_phase: ClassVar[str] = r"temporal\."
    sensors: ClassVar[tuple[str, ...]] = ("camera", "radar")

    fused_channels: int  # width of the fused map, which is also what is remembered
    radar_encoder: PillarConfig
    view_transform: LiftSplatConfig
    decoder: BEVDecoderConfig
    temporal: TemporalConfig | None  # null: single frames, phase 1
    head: HeadConfig
    loss: CameraRadarLossConfig

    def __post_init__(self) -> None:
        require_least(self, "model", {"channels": 1, "fused_channels": MIN_CHANNELS})


@dataclass
class CameraRadarOutput:
    """One frame through the model."""

    lifted: LiftedViews
    radar_bev: Tensor  # [B, C_radar, rows, cols]
    fused_bev: Tensor  # [B, C_fused, rows, cols]
    head: HeadOutput


class CameraRadarDetector(Detector):
    """Encoders of both sensors, a fusion that is the family's own, a convolutional decoder and a dense head.

    Raises ConfigError when parts, grid and backbone do not fit.
    """

    phase_options = BoxOptions
    latency_parts = {
        "image_encoder": ("image_encoder.forward",),
        "radar_encoder": ("radar_encoder.forward",),
        "view_transform": ("view_transform.forward", "fuser.forward"),
        # The way from the fused map to the head; where the paper books the decoder is not known.
        "temporal_fusion": ("temporal.recall", "temporal.aggregate", "temporal.remember", "decoder.forward"),
        "detection_head": ("head.forward", "head.decode"),
    }

    def __init__(
        self,
        config: CameraRadarConfig,
        grid: BEVGrid,
        backbone: ImageEncoderConfig | None,
        options: BoxOptions,
    ) -> None:
        super().__init__()
        if backbone is None:
            raise ConfigError(f"backbone=null: model={config.name} fuses radar with images; choose a backbone")
        self.config, self.grid = config, grid
        self.image_encoder = ImageEncoder(backbone, strides=(config.view_transform.image_stride_px,))
        self.radar_encoder = PillarEncoder(config.radar_encoder, grid)
        self.build_fusion()
        self.decoder = BEVDecoder(config.decoder, config.fused_channels, config.channels, grid)
        self.head = CenterHead(config.head, config.channels, grid, options.velocity_code_weight, dense=True)
        self.to(memory_format=torch.channels_last)

    @abstractmethod
    def build_fusion(self) -> None:
        """Make `view_transform`, `fuser`, `temporal` and what else lies between the encoders and the decoder."""

    def encode(
        self, batch: FrameBatch, memory: FrameMemory | None
    ) -> tuple[CameraViews, Tensor]:  # of one level, [B, C_radar, rows, cols]
        """Image features and the radar's map.

        Raises ValueError when images are absent or of another number, or when the memory is of other streams.
        """
        if memory is not None:
            memory.check_streams(batch)
        views = CameraViews.encode(self.image_encoder, batch)
        return views, self.radar_encoder(batch.radar_points, batch.radar_batch, len(batch))

    def loss_terms(self, output: CameraRadarOutput, batch: FrameBatch) -> Objective:
        """Weighted terms `heatmap`, `box` and `depth`."""
        weights = self.config.loss
        terms, counts = self.head.loss(output.head, batch.boxes, weights.heatmap_weight, weights.box_weight)
        if weights.depth_weight is not None:
            target = self.view_transform.depth_target(batch, self.image_encoder.image_size_px)
            total = depth_cross_entropy(output.lifted.depth_logits.flatten(0, 1), target)
            terms["depth"] = weights.depth_weight * total / mean_over_ranks((target >= 0).sum())
        return Objective(terms, counts)

    def diagnostics(self, output: CameraRadarOutput) -> dict[str, Tensor | float]:
        """Pillars and lifted pairs per frame, and how sure depth is."""
        frames = len(output.radar_bev)
        return {
            "pillars": output.radar_bev.any(dim=1).sum() / frames,
            "lifted_pairs": output.lifted.num_lifted / frames,
            "depth_confidence": output.lifted.depth_logits.float().softmax(2).amax(2).mean(),
        }
