"""PETR (Liu et al., ECCV 2022): cameras alone, boxes by queries that see every pixel with its place (method 13.3)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from src.errors import ConfigError, require_least
from src.geometry.bev_grid import BEVGrid
from src.losses.loss_weights import LossWeights
from src.models.backbones.image import ImageEncoder, ImageEncoderConfig
from src.models.detector import Detector, ModelConfig, Objective
from src.models.heads.center_head import BoxOptions
from src.models.heads.query_head import QueryHeadConfig, QueryPrediction, SetPredictionHead
from src.models.layers.views import CameraViews
from src.models.petr.decoder import PETRDecoder, PETRDecoderConfig
from src.models.petr.position_embedding import PositionEmbedding, PositionEmbeddingConfig
from src.models.query_memory import QueryMemory, QueryMemoryConfig, QueryPropagation, RecalledQueries
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from src.structures.evidence import Evidence
from src.structures.queries import Queries


@dataclass(kw_only=True)
class PETRLossConfig(LossWeights):
    """Weights of the terms (`model.loss`); null switches a term off, uncomputed."""

    class_weight: float | None  # of every layer's queries
    box_weight: float | None


@dataclass(kw_only=True)
class PETRConfig(ModelConfig):
    """Settings of the model (`model`). Raises ConfigError for parts that do not go together."""

    temporal_part: ClassVar[str] = "temporal"
    new_in_temporal_phase: ClassVar[str] = r"temporal\."

    image_stride_px: int  # of the one level of the image pyramid that queries look at
    num_queries: int
    position: PositionEmbeddingConfig
    decoder: PETRDecoderConfig
    temporal: QueryMemoryConfig | None  # null: single frames, phase 1
    head: QueryHeadConfig
    loss: PETRLossConfig

    def __post_init__(self) -> None:
        require_least(self, "model", {"channels": 1, "image_stride_px": 1, "num_queries": 1})

    @property
    def sensors(self) -> tuple[str, ...]:
        """Cameras alone."""
        return ("camera",)

    def scaled(
        self, gaussians: float = 1.0, memory_frames: int | None = None, cells_per_frame: int | None = None
    ) -> Self:
        """Remembered frames: queries are no Gaussians, and of each frame as many are remembered."""
        if memory_frames is None or self.temporal is None:
            return self
        return replace(self, temporal=replace(self.temporal, num_frames=memory_frames) if memory_frames else None)


@dataclass
class PETROutput:
    """One frame through the model."""

    layers: list[QueryPrediction]  # of the decoder
    recalled: RecalledQueries | None  # None in phase 1

    @property
    def head(self) -> QueryPrediction:
        """What the last layer predicts."""
        return self.layers[-1]


class PETR(Detector):
    """Image features with their 3D position embedding, and queries that begin at learnt anchors.

    Phase 2 carries queries on as StreamPETR does. Where every camera is missing, boxes come from the anchors (and what
    is remembered) alone. Raises ConfigError when parts, grid and backbone do not fit.
    """

    phase_options = BoxOptions
    latency_parts = {
        "image_encoder": ("image_encoder.forward",),
        "view_transform": ("position.forward",),
        "temporal_fusion": ("temporal.recall", "temporal.remember"),
        "detection_head": ("decoder.forward", "head.decode"),
    }

    def __init__(
        self, config: PETRConfig, grid: BEVGrid, backbone: ImageEncoderConfig | None, options: BoxOptions
    ) -> None:
        super().__init__()
        if backbone is None:
            raise ConfigError(f"backbone=null: model={config.name} sees by its cameras alone; choose a backbone")
        self.config, self.grid, channels = config, grid, config.channels
        self.image_encoder = ImageEncoder(backbone, strides=(config.image_stride_px,))
        self.image_value = nn.Linear(self.image_encoder.channels, channels)
        self.position = PositionEmbedding(config.position, channels, grid)
        # In units of the half extent, so that one step of Adam is of the order of a metre; uniform at first (Sec. 3.4).
        self.anchors = nn.Parameter(torch.empty(config.num_queries, 3).uniform_(-1.0, 1.0))
        (low, high), z = grid.z_range_m, sum(grid.z_range_m) / 2
        extent = torch.tensor([(*grid.centre_m, z), (*grid.half_extent_m, (high - low) / 2)])
        self.register_buffer("extent_m", extent, persistent=False)
        self.decoder = PETRDecoder(config.decoder, channels, grid)
        self.temporal = QueryPropagation(config.temporal, channels, grid) if config.temporal is not None else None
        self.head = SetPredictionHead(config.head, channels, grid, options.velocity_code_weight)

    @property
    def image_backbone(self) -> nn.Module:
        """Backbone without its neck."""
        return self.image_encoder.backbone

    def forward(self, batch: FrameBatch, memory: QueryMemory | None = None) -> tuple[PETROutput, QueryMemory | None]:
        """Detect in the frames of B streams, given what is remembered of them; the new memory is detached.

        Raises ValueError when images are absent, or when the memory is of another number of streams.
        """
        if memory is not None and memory.frames and memory.batch_size != len(batch):
            raise ValueError(f"the memory holds {memory.batch_size} streams, but the batch {len(batch)} frames")
        views = CameraViews.encode(self.image_encoder, batch)
        value = self.image_value(views.levels[0].movedim(2, -1))  # [B, N, h, w, C]
        valid = views.valid[:, :, None, None].expand(value.shape[:-1]).flatten(1)
        images = ((value + self.position(views)).flatten(1, 3), value.flatten(1, 3), valid)
        queries, past, recalled = self.anchor_queries(len(batch)), None, None
        if self.temporal is not None:
            recalled = self.temporal.recall(memory, batch)
            queries, past = Queries.concatenate([queries, recalled.newest]), recalled.older
        layers, features = self.decoder(queries, past, images, self.head)
        memory = self.temporal.remember(memory, batch, features, layers[-1]) if self.temporal is not None else None
        return PETROutput(layers, recalled), memory

    def anchor_queries(self, batch_size: int) -> Queries:
        """Queries at the learnt anchors, whose features begin at zero."""
        middle, half = self.extent_m.unbind(0)
        centers = (middle + half * self.anchors).expand(batch_size, -1, -1)
        features = centers.new_zeros(*centers.shape[:2], self.config.channels)
        return Queries.unknown(features, centers, torch.ones_like(centers[..., 0], dtype=torch.bool))

    def restore_memory(self, state: list[dict[str, Any]]) -> QueryMemory:
        """The memory that `QueryMemory.state` described."""
        return QueryMemory.from_state(state)

    def loss_terms(self, output: PETROutput, batch: FrameBatch) -> Objective:
        """Weighted terms `class` and `box`."""
        weights = self.config.loss
        terms, counts = self.head.loss(output.layers, batch.boxes, weights.class_weight, weights.box_weight)
        return Objective(terms, counts)

    def decode(self, output: PETROutput) -> list[Boxes3D]:
        """Boxes of each frame, best first."""
        return self.head.decode(output.head)

    def diagnostics(self, output: PETROutput) -> dict[str, Tensor | float]:
        """Queries and what is remembered, per frame."""
        values = {"queries": output.head.valid.sum() / len(output.head.valid)}
        return values if output.recalled is None else values | output.recalled.diagnostics()

    def evidence(self, output: PETROutput) -> Evidence:
        """Where remembered queries of the first sample are now."""
        return Evidence() if output.recalled is None else output.recalled.evidence()
