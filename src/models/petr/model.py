"""PETR (Liu et al., ECCV 2022): cameras alone, boxes by queries that see every pixel with its place (method 13.3)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import nn

from src.errors import require_least
from src.models.layers.views import CameraViews
from src.models.petr.decoder import PETRDecoder, PETRDecoderConfig
from src.models.petr.position_embedding import PositionEmbedding, PositionEmbeddingConfig
from src.models.query_detector import QueryDetector, QueryDetectorConfig, QueryOutput
from src.models.query_memory import QueryMemory
from src.structures.batch import FrameBatch
from src.structures.queries import Queries


@dataclass(kw_only=True)
class PETRConfig(QueryDetectorConfig):
    """Settings of the model (`model`). Raises ConfigError for parts that do not go together."""

    image_stride_px: int  # of the one level of the image pyramid that queries look at
    num_queries: int
    position: PositionEmbeddingConfig
    decoder: PETRDecoderConfig

    def __post_init__(self) -> None:
        require_least(self, "model", {"channels": 1, "image_stride_px": 1, "num_queries": 1})

    @property
    def sensors(self) -> tuple[str, ...]:
        """Cameras alone."""
        return ("camera",)

    @property
    def image_strides_px(self) -> tuple[int, ...]:
        """One level alone."""
        return (self.image_stride_px,)


class PETR(QueryDetector):
    """Image features with their 3D position embedding, and queries that begin at learnt anchors.

    Phase 2 carries queries on as StreamPETR does. Where every camera is missing, boxes come from the anchors (and what
    is remembered) alone.
    """

    latency_parts = QueryDetector.latency_parts | {"view_transform": ("position.forward",)}

    def build(self) -> None:
        """What images are told of places, the anchors, and the decoder."""
        config, grid, channels = self.config, self.grid, self.config.channels
        self.image_value = nn.Linear(self.image_encoder.channels, channels)
        self.position = PositionEmbedding(config.position, channels, grid)
        # In units of the half extent, so that one step of Adam is of the order of a metre; uniform at first (Sec. 3.4).
        self.anchors = nn.Parameter(torch.empty(config.num_queries, 3).uniform_(-1.0, 1.0))
        (low, high), z = grid.z_range_m, sum(grid.z_range_m) / 2
        extent = torch.tensor([(*grid.centre_m, z), (*grid.half_extent_m, (high - low) / 2)])
        self.register_buffer("extent_m", extent, persistent=False)
        self.decoder = PETRDecoder(config.decoder, channels, grid)

    def forward(self, batch: FrameBatch, memory: QueryMemory | None = None) -> tuple[QueryOutput, QueryMemory | None]:
        """Detect in the frames of B streams, given what is remembered of them; the new memory is detached.

        Raises ValueError when images are absent, or when the memory is of another number of streams.
        """
        views = CameraViews.encode(self.image_encoder, batch)
        value = self.image_value(views.levels[0].movedim(2, -1))  # [B, N, h, w, C]
        valid = views.valid[:, :, None, None].expand(value.shape[:-1]).flatten(1)
        images = ((value + self.position(views)).flatten(1, 3), value.flatten(1, 3), valid)
        layers, recalled, memory = self.ask(batch, memory, self.anchor_queries(len(batch)), images)
        return QueryOutput(layers, recalled), memory

    def anchor_queries(self, batch_size: int) -> Queries:
        """Queries at the learnt anchors, whose features begin at zero."""
        middle, half = self.extent_m.unbind(0)
        centers = (middle + half * self.anchors).expand(batch_size, -1, -1)
        features = centers.new_zeros(*centers.shape[:2], self.config.channels)
        return Queries.unknown(features, centers, torch.ones_like(centers[..., 0], dtype=torch.bool))
