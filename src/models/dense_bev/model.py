"""Dense baseline: radar-camera fusion on a whole BEV map, in the way of BEVFusion (method 13)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from src.errors import ConfigError, require_least
from src.geometry.bev_grid import BEVGrid
from src.losses.classification import depth_cross_entropy
from src.losses.loss_weights import LossWeights
from src.losses.normalizers import mean_over_ranks
from src.models.backbones.bev_decoder import MIN_CHANNELS, BEVDecoder, BEVDecoderConfig, ConvFuser
from src.models.backbones.image import ImageEncoder, ImageEncoderConfig
from src.models.backbones.pillars import PillarConfig, PillarEncoder
from src.models.dense_bev.temporal_fusion import MapMemory, TemporalConfig, TemporalFusion, WarpedMaps
from src.models.detector import Detector, ModelConfig, Objective
from src.models.heads.center_head import BoxOptions, CenterHead, HeadConfig, HeadOutput
from src.models.layers.lift_splat import LiftedViews, LiftSplat, LiftSplatConfig
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D


@dataclass(kw_only=True)
class DenseBEVLossConfig(LossWeights):
    """Weights of the terms (`model.loss`); null switches a term off, uncomputed."""

    heatmap_weight: float | None
    box_weight: float | None
    depth_weight: float | None


@dataclass(kw_only=True)
class DenseBEVConfig(ModelConfig):
    """Settings of the model (`model`). Raises ConfigError for parts that do not go together."""

    temporal_part: ClassVar[str] = "temporal"
    new_in_temporal_phase: ClassVar[str] = r"temporal\."

    fused_channels: int  # width of the fused map, which is also what is remembered
    radar_encoder: PillarConfig
    view_transform: LiftSplatConfig
    decoder: BEVDecoderConfig
    temporal: TemporalConfig | None  # null: single frames, phase 1
    head: HeadConfig
    loss: DenseBEVLossConfig

    def __post_init__(self) -> None:
        require_least(self, "model", {"channels": 1, "fused_channels": MIN_CHANNELS})

    @property
    def sensors(self) -> tuple[str, ...]:
        """Both always: without cameras there is nothing to fuse."""
        return ("camera", "radar")

    def scaled(
        self, gaussians: float = 1.0, memory_frames: int | None = None, cells_per_frame: int | None = None
    ) -> Self:
        """Remembered maps: there are no Gaussians, and every cell is remembered."""
        if memory_frames is None or self.temporal is None:
            return self
        return replace(self, temporal=replace(self.temporal, num_frames=memory_frames) if memory_frames else None)


@dataclass
class DenseBEVOutput:
    """One frame through the model."""

    views: LiftedViews
    radar_bev: Tensor  # [B, C_radar, rows, cols]
    fused_bev: Tensor  # [B, C_fused, rows, cols]
    warped_maps: WarpedMaps | None  # None in phase 1
    head: HeadOutput


class DenseBEV(Detector):
    """BEVFusion-style detector: lift-splat and pillars onto one dense map, a convolutional decoder, a dense head.

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
        config: DenseBEVConfig,
        grid: BEVGrid,
        backbone: ImageEncoderConfig | None,
        options: BoxOptions,
    ) -> None:
        super().__init__()
        if backbone is None:
            raise ConfigError("backbone=null: model=dense_bev fuses radar with images; choose a backbone")
        self.config, self.grid = config, grid
        self.image_encoder = ImageEncoder(backbone, strides=(config.view_transform.image_stride_px,))
        self.radar_encoder = PillarEncoder(config.radar_encoder, grid)
        self.view_transform = LiftSplat(config.view_transform, self.image_encoder.channels, grid)
        both = config.view_transform.context_channels + config.radar_encoder.channels
        self.fuser = ConvFuser(both, config.fused_channels)
        self.temporal = (
            TemporalFusion(config.temporal, config.fused_channels, grid) if config.temporal is not None else None
        )
        self.decoder = BEVDecoder(config.decoder, config.fused_channels, config.channels, grid)
        self.head = CenterHead(config.head, config.channels, grid, options.velocity_code_weight, dense=True)
        self.to(memory_format=torch.channels_last)

    @property
    def image_backbone(self) -> nn.Module:
        """Backbone without its neck."""
        return self.image_encoder.backbone

    def forward(self, batch: FrameBatch, memory: MapMemory | None = None) -> tuple[DenseBEVOutput, MapMemory | None]:
        """Detect in the frames of B streams, given what is remembered of them; the new memory is detached.

        Raises ValueError when images are absent, or when the memory is of another number of streams.
        """
        if batch.images is None or batch.image_valid is None or batch.pix_from_aug is None:
            raise ValueError("FrameBatch.images is None, but this model uses images; read them with the frames")
        if memory is not None and memory.frames and memory.batch_size != len(batch):
            raise ValueError(f"the memory holds {memory.batch_size} streams, but the batch {len(batch)} frames")
        warped_maps = self.temporal.recall(memory, batch) if self.temporal is not None else None
        (level,) = self.image_encoder(batch.images)
        views = self.view_transform(level, batch.pix_from_aug, batch.image_valid, self.image_encoder.image_size_px)
        radar_bev = self.radar_encoder(batch.radar_points, batch.radar_batch, len(batch))
        current = fused = self.fuser(views.bev, radar_bev)
        if self.temporal is not None:
            current, memory = self.temporal.aggregate(fused, warped_maps), self.temporal.remember(memory, batch, fused)
        output = DenseBEVOutput(views, radar_bev, fused, warped_maps, self.head(self.decoder(current)))
        return output, memory if self.temporal is not None else None

    def restore_memory(self, state: list[dict[str, Any]]) -> MapMemory:
        """The memory that `MapMemory.state` described."""
        return MapMemory.from_state(state)

    def loss_terms(self, output: DenseBEVOutput, batch: FrameBatch) -> Objective:
        """Weighted terms `heatmap`, `box` and `depth`."""
        weights = self.config.loss
        terms, counts = self.head.loss(output.head, batch.boxes, weights.heatmap_weight, weights.box_weight)
        if weights.depth_weight is not None:
            target = self.view_transform.depth_target(batch, self.image_encoder.image_size_px)
            total = depth_cross_entropy(output.views.depth_logits.flatten(0, 1), target)
            terms["depth"] = weights.depth_weight * total / mean_over_ranks((target >= 0).sum())
        return Objective(terms, counts)

    def decode(self, output: DenseBEVOutput) -> list[Boxes3D]:
        """Boxes of each frame, best first."""
        return self.head.decode(output.head)

    def diagnostics(self, output: DenseBEVOutput) -> dict[str, Tensor | float]:
        """Pillars and lifted pairs per frame, how sure depth is, past maps in use."""
        frames = len(output.radar_bev)
        probabilities = output.views.depth_logits.float().softmax(2)  # [B, N, D, h, w]
        values: dict[str, Tensor | float] = {
            "pillars": output.radar_bev.any(dim=1).sum() / frames,
            "lifted_pairs": output.views.num_lifted / frames,
            "depth_confidence": probabilities.amax(2).mean(),
        }
        if output.warped_maps is not None:
            values["remembered_frames"] = output.warped_maps.usable.sum() / frames
        return values
