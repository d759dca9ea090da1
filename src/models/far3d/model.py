"""Far3D (Jiang et al., AAAI 2024): cameras alone, queries that start at objects found in the images (method 13.6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from src.errors import require_least
from src.models.detector import Objective
from src.models.far3d.adaptive_queries import AdaptiveQueries, AdaptiveQueryConfig
from src.models.far3d.perspective_decoder import PerspectiveDecoder, PerspectiveDecoderConfig
from src.models.heads.keypoint_head import CameraMaps
from src.models.layers.feed_forward import check_image_heads
from src.models.layers.views import CameraViews
from src.models.query_detector import CameraQueryLossConfig, QueryDetector, QueryDetectorConfig, QueryOutput
from src.models.query_memory import QueryMemory
from src.structures.batch import FrameBatch
from src.structures.queries import Queries
from src.structures.taxonomy import CAMERAS


@dataclass(kw_only=True)
class Far3DConfig(QueryDetectorConfig):
    """Settings of the model (`model`). Raises ConfigError for parts that do not go together."""

    sensors: ClassVar[tuple[str, ...]] = ("camera",)

    num_queries: int  # at learnt places
    queries: AdaptiveQueryConfig
    decoder: PerspectiveDecoderConfig
    loss: CameraQueryLossConfig

    def __post_init__(self) -> None:
        require_least(self, "model", {"num_queries": 1})
        check_image_heads(self.channels)


@dataclass
class Far3DOutput(QueryOutput):
    """One frame through the model."""

    views: CameraViews
    camera: CameraMaps
    adaptive: Queries


class Far3D(QueryDetector):
    """Adaptive queries beside those at learnt anchors; all gather from the images around their places.

    Phase 2 carries queries on as StreamPETR does.
    """

    latency_parts = QueryDetector.latency_parts | {"view_transform": ("proposals.forward",)}

    def build(self) -> None:
        """Proposals, anchors and decoder."""
        config, grid, channels = self.config, self.grid, self.config.channels
        strides, width = self.image_encoder.strides, self.image_encoder.channels
        self.proposals = AdaptiveQueries(config.queries, channels, width, grid)
        self.add_anchors(config.num_queries)
        self.decoder = PerspectiveDecoder(config.decoder, channels, width, len(CAMERAS), len(strides), grid)

    def forward(self, batch: FrameBatch, memory: QueryMemory | None = None) -> tuple[Far3DOutput, QueryMemory | None]:
        """Detect in the frames of B streams, given what is remembered of them; the new memory is detached.

        Raises ValueError when images are absent, or when the memory is of another number of streams.
        """
        views = CameraViews.encode(self.image_encoder, batch)
        adaptive, camera = self.proposals(views)
        queries = Queries.concatenate([self.anchor_queries(len(batch)), adaptive], dim=1)
        output, memory = self.run_decoder(batch, memory, queries, views)
        return Far3DOutput(**vars(output), views=views, camera=camera, adaptive=adaptive), memory

    def loss_terms(self, output: Far3DOutput, batch: FrameBatch) -> Objective:
        """Weighted terms `class`, `box`, `keypoint` and `depth`."""
        terms, counts = super().loss_terms(output, batch)
        terms |= self.camera_terms(output.camera, output.views, self.config.queries.depth_range, batch)
        return Objective(terms, counts)

    def diagnostics(self, output: Far3DOutput) -> dict[str, Tensor | float]:
        """Adaptive and all queries, and what is remembered, per frame."""
        adaptive = output.adaptive.valid.sum() / len(output.adaptive.valid)
        return {"adaptive_queries": adaptive} | super().diagnostics(output)
