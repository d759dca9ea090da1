"""SpaRC (Wolters et al., 2024): sparse radar-camera fusion, boxes by object queries alone (method 13.2)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from src.losses.classification import penalty_reduced_focal
from src.losses.normalizers import mean_over_ranks
from src.models.detector import Objective
from src.models.layers.feed_forward import check_image_heads
from src.models.layers.views import CameraViews
from src.models.query_detector import CameraQueryLossConfig, QueryDetector, QueryDetectorConfig, QueryOutput
from src.models.query_memory import QueryMemory
from src.models.sparc.frustum_fusion import FrustumFusionConfig, SparseFrustumFusion
from src.models.sparc.point_transformer import PointTransformer, PointTransformerConfig, RadarPoints
from src.models.sparc.query_proposals import ProposalConfig, Proposals, QueryProposals
from src.models.sparc.sparc_decoder import SpaRCDecoder, SpaRCDecoderConfig
from src.structures.batch import FrameBatch
from src.structures.taxonomy import CAMERAS
from src.targets.heatmap import head_targets


@dataclass(kw_only=True)
class SpaRCLossConfig(CameraQueryLossConfig):
    """Weights of the terms (`model.loss`); null switches a term off, uncomputed."""

    heatmap_weight: float | None  # of the radar points


@dataclass(kw_only=True)
class SpaRCConfig(QueryDetectorConfig):
    """Settings of the model (`model`). Raises ConfigError for parts that do not go together."""

    radar_encoder: PointTransformerConfig
    fusion: FrustumFusionConfig
    queries: ProposalConfig
    decoder: SpaRCDecoderConfig
    loss: SpaRCLossConfig

    def __post_init__(self) -> None:
        check_image_heads(self.channels)


@dataclass
class SpaRCOutput(QueryOutput):
    """One frame through the model."""

    radar: RadarPoints
    views: CameraViews
    proposals: Proposals


class SpaRC(QueryDetector):
    """Radar points and images fused in their frusta; queries that gather from both."""

    latency_parts = QueryDetector.latency_parts | {
        "radar_encoder": ("radar_encoder.forward",),
        "view_transform": ("fusion.forward", "proposals.forward"),
    }

    def build(self) -> None:
        """Radar encoder, fusion, proposals and decoder."""
        config, grid, channels = self.config, self.grid, self.config.channels
        strides, width = self.image_encoder.strides, self.image_encoder.channels
        self.radar_encoder = PointTransformer(config.radar_encoder, grid)
        sizes = (self.radar_encoder.channels, width, channels)
        self.fusion = SparseFrustumFusion(config.fusion, *sizes, strides, grid)
        self.proposals = QueryProposals(config.queries, channels, width, grid)
        self.decoder = SpaRCDecoder(config.decoder, channels, width, len(CAMERAS), len(strides), grid)

    def forward(self, batch: FrameBatch, memory: QueryMemory | None = None) -> tuple[SpaRCOutput, QueryMemory | None]:
        """Detect in the frames of B streams, given what is remembered of them; the new memory is detached.

        Raises ValueError when images are absent, or when the memory is of another number of streams.
        """
        radar = self.radar_encoder(batch.radar_points, batch.radar_batch, len(batch))
        radar, views = self.fusion(radar, CameraViews.encode(self.image_encoder, batch))
        proposals = self.proposals(radar, views)
        output, memory = self.run_decoder(batch, memory, proposals.queries, radar.padded(), views)
        return SpaRCOutput(**vars(output), radar=radar, views=views, proposals=proposals), memory

    def loss_terms(self, output: SpaRCOutput, batch: FrameBatch) -> Objective:
        """Weighted terms `class`, `box`, `heatmap`, `keypoint` and `depth`."""
        weights = self.config.loss
        terms, counts = super().loss_terms(output, batch)
        if weights.heatmap_weight is not None:
            target = head_targets(batch.boxes, output.radar.bev.sites, self.grid).heatmap
            total = penalty_reduced_focal(output.proposals.heatmap_logits, target).sum()
            terms["heatmap"] = weights.heatmap_weight * total / mean_over_ranks((target == 1).sum())
        terms |= self.camera_terms(output.proposals.camera, output.views, self.config.queries.depth_range, batch)
        return Objective(terms, counts)

    def diagnostics(self, output: SpaRCOutput) -> dict[str, Tensor | float]:
        """Radar points, queries and what is remembered, per frame."""
        return {"radar_points": len(output.radar.bev) / len(output.head.valid)} | super().diagnostics(output)
