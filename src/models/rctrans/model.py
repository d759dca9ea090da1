"""RCTrans (Li et al., AAAI 2025): a densified radar map and images, each attended to in turn (method 13.5)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from src.errors import ConfigError, require_least
from src.geometry.bev_grid import BEVGrid
from src.models.backbones.pillars import PillarConfig, PillarEncoder
from src.models.layers.position_embedding import PositionEmbeddingConfig
from src.models.layers.views import CameraViews
from src.models.query_detector import QueryDetector, QueryDetectorConfig, QueryOutput
from src.models.query_memory import QueryMemory
from src.models.rctrans.radar_densifier import DensifierConfig, RadarDensifier
from src.models.rctrans.sequential_decoder import SequentialDecoder, SequentialDecoderConfig
from src.structures.batch import FrameBatch


@dataclass(kw_only=True)
class RCTransConfig(QueryDetectorConfig):
    """Settings of the model (`model`). Raises ConfigError for parts that do not go together."""

    image_stride_px: int  # of the one level of the image pyramid that queries look at
    num_queries: int
    pillar_cells: int  # edge of a pillar, and of a radar token, in cells of the grid
    radar_encoder: PillarConfig
    densifier: DensifierConfig
    position: PositionEmbeddingConfig
    decoder: SequentialDecoderConfig

    def __post_init__(self) -> None:
        require_least(self, "model", {"channels": 1, "image_stride_px": 1, "num_queries": 1, "pillar_cells": 1})

    @property
    def image_strides_px(self) -> tuple[int, ...]:
        """One level alone."""
        return (self.image_stride_px,)


@dataclass
class RCTransOutput(QueryOutput):
    """One frame through the model."""

    pillars: Tensor  # [B, C_R, rows, cols], zero where no point fell


class RCTrans(QueryDetector):
    """Pillars densified to a map without holes; queries from learnt anchors that look at it and at images in turn.

    Later layers of the decoder teach the earlier ones and are left out in inference.
    """

    latency_parts = QueryDetector.latency_parts | {"radar_encoder": ("radar_encoder.forward", "densifier.forward")}

    def build(self) -> None:
        """Radar encoder, its densifier, the anchors and the decoder."""
        config, grid, size = self.config, self.grid, self.config.pillar_cells
        if any(cells % size for cells in grid.cells):
            raise ConfigError(f"model.pillar_cells={size}: must divide grid.cells={list(grid.cells)}")
        grid = BEVGrid((grid.rows // size, grid.cols // size), size * grid.cell_m, grid.centre_m, grid.z_range_m)
        self.radar_encoder = PillarEncoder(config.radar_encoder, grid)
        self.densifier = RadarDensifier(config.densifier, config.radar_encoder.channels, grid)
        self.add_anchors(config.num_queries, learnt_features=True)
        widths = (config.channels, config.densifier.channels, self.image_encoder.channels)
        self.decoder = SequentialDecoder(config.decoder, config.position, *widths, grid)

    @property
    def output_layer(self) -> int:
        """The last one that is left in inference."""
        return self.config.decoder.num_inference_layers - 1

    def forward(self, batch: FrameBatch, memory: QueryMemory | None = None) -> tuple[RCTransOutput, QueryMemory | None]:
        """Detect in the frames of B streams, given what is remembered of them; the new memory is detached.

        Raises ValueError when images are absent, or when the memory is of another number of streams.
        """
        views = CameraViews.encode(self.image_encoder, batch)
        pillars = self.radar_encoder(batch.radar_points, batch.radar_batch, len(batch))
        radar = self.densifier(pillars)
        output, memory = self.run_decoder(batch, memory, self.anchor_queries(len(batch)), radar, views)
        return RCTransOutput(**vars(output), pillars=pillars), memory

    def diagnostics(self, output: RCTransOutput) -> dict[str, Tensor | float]:
        """Pillars, queries and what is remembered, per frame."""
        pillars = output.pillars.any(dim=1).sum() / len(output.pillars)
        return {"pillars": pillars} | super().diagnostics(output)
