"""SpaRC (Wolters et al., 2024): sparse radar-camera fusion, boxes by object queries alone (method 13.2)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

from torch import Tensor, nn

from src.errors import ConfigError, require_least
from src.geometry.bev_grid import BEVGrid
from src.losses.classification import penalty_reduced_focal
from src.losses.loss_weights import LossWeights
from src.losses.normalizers import mean_over_ranks
from src.models.backbones.image import ImageEncoder, ImageEncoderConfig
from src.models.backbones.point_transformer import PointTransformer, PointTransformerConfig, RadarPoints
from src.models.detector import Detector, ModelConfig, Objective
from src.models.heads.center_head import BoxOptions
from src.models.heads.keypoint_head import camera_losses
from src.models.heads.query_head import QueryHeadConfig, QueryPrediction, SetPredictionHead
from src.models.heads.query_proposals import ProposalConfig, Proposals, QueryProposals
from src.models.layers.query_decoder import QueryDecoder, QueryDecoderConfig
from src.models.layers.views import CameraViews
from src.models.query_memory import QueryMemory, QueryMemoryConfig, QueryPropagation, RecalledQueries
from src.models.sparc.frustum_fusion import FrustumFusionConfig, SparseFrustumFusion
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from src.structures.evidence import Evidence
from src.structures.queries import Queries
from src.structures.taxonomy import CAMERAS
from src.targets.heatmap import head_targets
from src.targets.projection import view_boxes
from src.targets.supervision import supervised_boxes, upload_boxes


@dataclass(kw_only=True)
class SpaRCLossConfig(LossWeights):
    """Weights of the terms (`model.loss`); null switches a term off, uncomputed."""

    class_weight: float | None  # of every layer's queries
    box_weight: float | None
    heatmap_weight: float | None  # of the radar points
    keypoint_weight: float | None  # of the images
    depth_weight: float | None


@dataclass(kw_only=True)
class SpaRCConfig(ModelConfig):
    """Settings of the model (`model`). Raises ConfigError for parts that do not go together."""

    temporal_part: ClassVar[str] = "temporal"
    new_in_temporal_phase: ClassVar[str] = r"temporal\."

    radar_encoder: PointTransformerConfig
    fusion: FrustumFusionConfig
    queries: ProposalConfig
    decoder: QueryDecoderConfig
    temporal: QueryMemoryConfig | None  # null: single frames, phase 1
    head: QueryHeadConfig
    loss: SpaRCLossConfig

    def __post_init__(self) -> None:
        require_least(self, "model", {"channels": 4})
        if self.channels % 4:
            raise ConfigError(f"model.channels={self.channels}: must be a multiple of 4, the heads of image attention")

    @property
    def sensors(self) -> tuple[str, ...]:
        """Both always: without cameras there is nothing to fuse."""
        return ("camera", "radar")

    def scaled(
        self, gaussians: float = 1.0, memory_frames: int | None = None, cells_per_frame: int | None = None
    ) -> Self:
        """Remembered frames: queries are no Gaussians, and of each frame as many are remembered."""
        if memory_frames is None or self.temporal is None:
            return self
        return replace(self, temporal=replace(self.temporal, num_frames=memory_frames) if memory_frames else None)


@dataclass
class SpaRCOutput:
    """One frame through the model."""

    radar: RadarPoints
    views: CameraViews
    proposals: Proposals
    layers: list[QueryPrediction]  # of the decoder
    recalled: RecalledQueries | None  # None in phase 1

    @property
    def head(self) -> QueryPrediction:
        """What the last layer predicts."""
        return self.layers[-1]


class SpaRC(Detector):
    """Radar points and images fused in their frusta; queries that gather from both. Raises ConfigError when parts,
    grid and backbone do not fit."""

    phase_options = BoxOptions
    latency_parts = {
        "image_encoder": ("image_encoder.forward",),
        "radar_encoder": ("radar_encoder.forward",),
        "view_transform": ("fusion.forward", "proposals.forward"),
        "temporal_fusion": ("temporal.recall", "temporal.remember"),
        "detection_head": ("decoder.forward", "head.decode"),
    }

    def __init__(
        self, config: SpaRCConfig, grid: BEVGrid, backbone: ImageEncoderConfig | None, options: BoxOptions
    ) -> None:
        super().__init__()
        if backbone is None:
            raise ConfigError(f"backbone=null: model={config.name} fuses radar with images; choose a backbone")
        self.config, self.grid, channels = config, grid, config.channels
        self.image_encoder = ImageEncoder(backbone)
        strides, width = self.image_encoder.strides, self.image_encoder.channels
        self.radar_encoder = PointTransformer(config.radar_encoder, grid)
        sizes = (self.radar_encoder.channels, width, channels)
        self.fusion = SparseFrustumFusion(config.fusion, *sizes, strides, grid)
        self.proposals = QueryProposals(config.queries, channels, width, grid)
        self.decoder = QueryDecoder(config.decoder, channels, width, len(CAMERAS), len(strides), grid)
        self.temporal = QueryPropagation(config.temporal, channels, grid) if config.temporal is not None else None
        self.head = SetPredictionHead(config.head, channels, grid, options.velocity_code_weight)

    @property
    def image_backbone(self) -> nn.Module:
        """Backbone without its neck."""
        return self.image_encoder.backbone

    def forward(self, batch: FrameBatch, memory: QueryMemory | None = None) -> tuple[SpaRCOutput, QueryMemory | None]:
        """Detect in the frames of B streams, given what is remembered of them; the new memory is detached.

        Raises ValueError when images are absent, or when the memory is of another number of streams.
        """
        if memory is not None and memory.frames and memory.batch_size != len(batch):
            raise ValueError(f"the memory holds {memory.batch_size} streams, but the batch {len(batch)} frames")
        radar = self.radar_encoder(batch.radar_points, batch.radar_batch, len(batch))
        radar, views = self.fusion(radar, CameraViews.encode(self.image_encoder, batch))
        proposals = self.proposals(radar, views)
        queries, past, recalled = proposals.queries, None, None
        if self.temporal is not None:
            recalled = self.temporal.recall(memory, batch)
            queries, past = Queries.concatenate([queries, recalled.newest]), recalled.older
        layers, features = self.decoder(queries, past, radar.padded(), views, self.head)
        memory = self.temporal.remember(memory, batch, features, layers[-1]) if self.temporal is not None else None
        return SpaRCOutput(radar, views, proposals, layers, recalled), memory

    def restore_memory(self, state: list[dict[str, Any]]) -> QueryMemory:
        """The memory that `QueryMemory.state` described."""
        return QueryMemory.from_state(state)

    def loss_terms(self, output: SpaRCOutput, batch: FrameBatch) -> Objective:
        """Weighted terms `class`, `box`, `heatmap`, `keypoint` and `depth`."""
        weights = self.config.loss
        terms, counts = self.head.loss(output.layers, batch.boxes, weights.class_weight, weights.box_weight)
        if weights.heatmap_weight is not None:
            target = head_targets(batch.boxes, output.radar.bev.sites, self.grid).heatmap
            total = penalty_reduced_focal(output.proposals.heatmap_logits, target).sum()
            terms["heatmap"] = weights.heatmap_weight * total / mean_over_ranks((target == 1).sum())
        if weights.keypoint_weight is not None or weights.depth_weight is not None:
            views = output.views
            boxes, samples = upload_boxes(*supervised_boxes(batch.boxes, self.grid), device=batch.device)
            seen = view_boxes(boxes, samples, views.pix_from_aug, views.valid, views.image_size_px)
            wanted = (weights.keypoint_weight, weights.depth_weight)
            terms |= camera_losses(output.proposals.camera, views, seen, self.config.queries.depth_range, *wanted)
        return Objective(terms, counts)

    def decode(self, output: SpaRCOutput) -> list[Boxes3D]:
        """Boxes of each frame, best first."""
        return self.head.decode(output.head)

    def diagnostics(self, output: SpaRCOutput) -> dict[str, Tensor | float]:
        """Radar points, queries and what is remembered, per frame."""
        frames = len(output.head.valid)
        values = {"radar_points": len(output.radar.bev) / frames, "queries": output.head.valid.sum() / frames}
        return values if output.recalled is None else values | output.recalled.diagnostics()

    def evidence(self, output: SpaRCOutput) -> Evidence:
        """Where remembered queries of the first sample are now."""
        return Evidence() if output.recalled is None else output.recalled.evidence()
