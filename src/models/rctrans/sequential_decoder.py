"""RCTrans' pruning sequential decoder: radar first, then cameras, then where both have led to."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.errors import ConfigError, require_least
from src.geometry.bev_grid import BEVGrid
from src.models.heads.query_head import QueryPrediction, SetPredictionHead
from src.models.layers.dense import Conv2d
from src.models.layers.global_attention import GlobalDecoderLayer
from src.models.layers.position_embedding import PositionEmbedding, PositionEmbeddingConfig
from src.models.layers.query_attention import DistanceAttention, SinePositionEmbedding, check_decoder_heads
from src.models.layers.views import CameraViews
from src.structures.queries import Queries


@dataclass(kw_only=True)
class SequentialDecoderConfig:
    """Settings of the decoder (`model.decoder`). Raises ConfigError for values that cannot work."""

    num_layers: int  # in training; each looks at the radar and at the cameras
    num_inference_layers: int  # the first so many give the boxes and what is remembered; the others are pruned
    num_heads: int
    num_radar_cells: int | None  # nearest cells of the radar's map that a query looks at; null: all, as published

    def __post_init__(self) -> None:
        counts = ("num_layers", "num_inference_layers", "num_heads", "num_radar_cells")
        require_least(self, "model.decoder", dict.fromkeys(counts, 1))
        if self.num_inference_layers > self.num_layers:
            raise ConfigError(
                f"model.decoder.num_inference_layers={self.num_inference_layers}: must not exceed "
                f"model.decoder.num_layers={self.num_layers}"
            )


class SequentialLayer(nn.Module):
    """A whole decoder layer on the radar's tokens, then one on the cameras'.

    A radar hardly measures elevation: on the plane the query finds where to look in the images.
    """

    def __init__(self, channels: int, config: SequentialDecoderConfig) -> None:
        super().__init__()
        self.radar, self.camera = (GlobalDecoderLayer(channels, config.num_heads) for _ in range(2))
        if config.num_radar_cells is not None:
            self.radar.cross_attention = DistanceAttention(channels, config.num_heads, config.num_radar_cells)


class SequentialDecoder(nn.Module):
    """Layers whose predicted centres are where the next one's queries stand; both of their position embeddings follow.

    On the plane that is an embedding of the place, which the radar's cells share; in the images an embedding of the ray
    of the pixel at which the place is seen, which the pixels share. Gradients do not pass from place to place.
    """

    def __init__(
        self,
        config: SequentialDecoderConfig,
        position: PositionEmbeddingConfig,
        channels: int,
        radar_channels: int,
        image_channels: int,
        grid: BEVGrid,  # of the radar's tokens
    ) -> None:
        super().__init__()
        check_decoder_heads(config.num_heads, channels)
        self.config = config
        self.radar_value, self.image_value = (
            token_layers(radar_channels, channels),
            token_layers(image_channels, channels),
        )
        self.radar_norm, self.image_norm = nn.LayerNorm(channels), nn.LayerNorm(channels)
        self.plane = SinePositionEmbedding(channels, grid, coordinates=2)
        self.perspective = PositionEmbedding(position, channels, grid, logits=False)
        places = torch.cartesian_prod(torch.arange(grid.rows), torch.arange(grid.cols))
        self.register_buffer("places_m", grid.centre_of(places), persistent=False)
        self.layers = nn.ModuleList(SequentialLayer(channels, config) for _ in range(config.num_layers))
        self.norm = nn.LayerNorm(channels)

    def forward(
        self,
        queries: Queries,
        past: Queries | None,  # further ones to look at
        radar: Tensor,  # [B, C_R, rows, cols]
        views: CameraViews,
        head: SetPredictionHead,
    ) -> tuple[list[QueryPrediction], list[Tensor]]:  # of each layer, and [B, Q, C]
        """What every layer predicts, and the features that it predicts from; in evaluation without the pruned ones."""
        cells, pixels = self.radar_tokens(radar), self.image_tokens(views)
        remembered = (None, None)
        if past is not None:
            embeddings = (self.plane(past.centers), self.perspective.of_points(past.centers, views))
            remembered = tuple((past.features + one, past.features, past.valid) for one in embeddings)
        near = self.config.num_radar_cells is not None
        places = F.pad(self.places_m, (0, 1)).expand(len(radar), -1, -1)
        predictions, features = [], []
        for layer in self.layers if self.training else self.layers[: self.config.num_inference_layers]:
            seen = (queries.centers, cells[0], places, cells[2]) if near else cells
            x = layer.radar(queries, self.plane(queries.centers), remembered[0], seen)
            queries = replace(queries, features=x)
            x = layer.camera(queries, self.perspective.of_points(queries.centers, views), remembered[1], pixels)
            features.append(self.norm(x))
            predictions.append(head(features[-1], queries))
            queries = replace(queries, features=x, centers=predictions[-1].codes[..., :3].detach())
        return predictions, features

    def radar_tokens(self, radar: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Keys, values and validity of every cell, empty ones too."""
        value = self.radar_norm(self.radar_value(radar).flatten(2).transpose(1, 2))  # [B, cells, C]
        return value + self.plane(self.places_m), value, torch.ones_like(value[..., 0], dtype=torch.bool)

    def image_tokens(self, views: CameraViews) -> tuple[Tensor, Tensor, Tensor]:
        """Keys, values and validity of every pixel of the finest level of all cameras."""
        level = views.levels[0]
        value = self.image_value(level.flatten(0, 1)).unflatten(0, level.shape[:2])
        value = self.image_norm(value.movedim(2, -1))  # [B, N, h, w, C]
        valid = views.valid[:, :, None, None].expand(value.shape[:-1])
        return (value + self.perspective(views)).flatten(1, 3), value.flatten(1, 3), valid.flatten(1)


def token_layers(in_channels: int, channels: int) -> nn.Sequential:
    """A sensor's map to the width of the queries."""
    return nn.Sequential(
        Conv2d(in_channels, channels, 3, padding=1), nn.ReLU(), Conv2d(channels, channels, 3, padding=1)
    )
