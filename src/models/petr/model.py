"""PETR (Liu et al., ECCV 2022): cameras alone, boxes by queries that see every pixel with its place (method 13.3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import nn

from src.errors import require_least
from src.models.layers.position_embedding import PositionEmbedding, PositionEmbeddingConfig
from src.models.layers.views import CameraViews
from src.models.petr.decoder import PETRDecoder, PETRDecoderConfig
from src.models.query_detector import QueryDetector, QueryDetectorConfig, QueryOutput
from src.models.query_memory import QueryMemory
from src.structures.batch import FrameBatch


@dataclass(kw_only=True)
class PETRConfig(QueryDetectorConfig):
    """Settings of the model (`model`). Raises ConfigError for parts that do not go together."""

    sensors: ClassVar[tuple[str, ...]] = ("camera",)

    image_stride_px: int  # of the one level of the image pyramid that queries look at
    num_queries: int
    position: PositionEmbeddingConfig
    decoder: PETRDecoderConfig

    def __post_init__(self) -> None:
        require_least(self, "model", {"channels": 1, "image_stride_px": 1, "num_queries": 1})

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
        self.image_value = nn.Sequential(nn.Linear(self.image_encoder.channels, channels), nn.LayerNorm(channels))
        self.position = PositionEmbedding(config.position, channels, grid)
        self.add_anchors(config.num_queries, learnt_features=True)
        self.decoder = PETRDecoder(config.decoder, channels, grid)

    def forward(self, batch: FrameBatch, memory: QueryMemory | None = None) -> tuple[QueryOutput, QueryMemory | None]:
        """Detect in the frames of B streams, given what is remembered of them; the new memory is detached.

        Raises ValueError when images are absent, or when the memory is of another number of streams.
        """
        views = CameraViews.encode(self.image_encoder, batch)
        value = self.image_value(views.levels[0].movedim(2, -1))  # [B, N, h, w, C]
        valid = views.valid[:, :, None, None].expand(value.shape[:-1]).flatten(1)
        images = ((value + self.position(views)).flatten(1, 3), value.flatten(1, 3), valid)
        return self.run_decoder(batch, memory, self.anchor_queries(len(batch)), images)
