"""Decoder of object queries: they look at one another, at the radar near them and at the images, layer by layer."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from src.errors import require_least
from src.geometry.bev_grid import BEVGrid
from src.models.heads.query_head import QueryPrediction, SetPredictionHead
from src.models.layers.dense import Conv2d
from src.models.layers.feed_forward import feed_forward
from src.models.layers.image_attention import ImageCrossAttention, PointOffsets
from src.models.layers.query_attention import DistanceAttention, QueryEmbedding, check_decoder_heads
from src.models.layers.views import CameraViews
from src.models.sparc.point_transformer import PaddedPoints
from src.structures.queries import Queries

FFN_RATIO = 4
INITIAL_REACH_M = 1.5
"""Untrained, the sampling points lie within this distance of their query along each axis."""


@dataclass(kw_only=True)
class SpaRCDecoderConfig:
    """Settings of the decoder (`model.decoder`). Raises ConfigError for values that cannot work."""

    num_layers: int
    num_heads: int
    num_neighbours: int  # nearest queries that one looks at
    num_radar_points: int  # nearest radar points
    num_points: int  # sampling points in the images

    def __post_init__(self) -> None:
        least = dict.fromkeys(("num_layers", "num_heads", "num_neighbours", "num_radar_points", "num_points"), 1)
        require_least(self, "model.decoder", least)


class SpaRCDecoderLayer(nn.Module):
    """Local self-attention, range-adaptive radar aggregation, image attention and an MLP, each added."""

    def __init__(self, config: SpaRCDecoderConfig, channels: int, num_views: int, num_levels: int) -> None:
        super().__init__()
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(4))
        self.self_attention = DistanceAttention(channels, config.num_heads, config.num_neighbours)
        self.radar_attention = DistanceAttention(channels, config.num_heads, config.num_radar_points)
        self.offsets = PointOffsets(channels, config.num_points, INITIAL_REACH_M)
        self.image_attention = ImageCrossAttention(channels, config.num_points, num_views, num_levels)
        self.mlp = feed_forward(channels, FFN_RATIO)

    def forward(
        self,
        queries: Queries,
        embedding: Tensor,  # [B, Q, C]
        past: Queries | None,  # further ones to look at, with features [B, n, C] that hold their embedding
        radar: PaddedPoints,
        views: CameraViews,
        values: list[Tensor],  # L x [B, N, C, h, w]
    ) -> Tensor:  # [B, Q, C]
        """The queries' features after this layer."""
        x, centers = queries.features, queries.centers
        query = self.norms[0](x) + embedding
        keys, places = query, centers
        if past is not None:
            keys = torch.cat([keys, past.features.to(query.dtype)], dim=1)
            places = torch.cat([places, past.centers], dim=1)
        seen = queries.seen(None if past is None else past.valid)
        x = x + self.self_attention(query, centers, keys, places, seen)
        query = self.norms[1](x) + embedding
        x = x + self.radar_attention(query, centers, radar.features, radar.xyz, radar.valid)
        query = self.norms[2](x) + embedding
        points = self.offsets(query, centers)
        x = x + self.image_attention(x, query, points, views, values)
        return x + self.mlp(self.norms[3](x))


class SpaRCDecoder(nn.Module):
    """Layers each of which predicts relative to where its query began, and looks where the one before it predicted.

    Gradients do not pass from place to place. Changes of changes would ask one head for another answer in every layer.
    """

    def __init__(
        self,
        config: SpaRCDecoderConfig,
        channels: int,
        image_channels: int,
        num_views: int,
        num_levels: int,
        grid: BEVGrid,
    ) -> None:
        super().__init__()
        check_decoder_heads(config.num_heads, channels)
        self.embedding = QueryEmbedding(channels, grid)
        self.image_value = Conv2d(image_channels, channels, 1)
        sizes = (channels, num_views, num_levels)
        self.layers = nn.ModuleList(SpaRCDecoderLayer(config, *sizes) for _ in range(config.num_layers))
        self.norm = nn.LayerNorm(channels)

    def forward(
        self, queries: Queries, past: Queries | None, radar: PaddedPoints, views: CameraViews, head: SetPredictionHead
    ) -> tuple[list[QueryPrediction], list[Tensor]]:  # of each layer, and [B, Q, C]
        """What every layer predicts, and the features that it predicts from."""
        values = [self.image_value(x.flatten(0, 1)).unflatten(0, x.shape[:2]) for x in views.levels]
        if past is not None:
            past = replace(past, features=past.features + self.embedding(past))
        predictions, features, start = [], [], queries
        for layer in self.layers:
            x = layer(queries, self.embedding(queries), past, radar, views, values)
            features.append(self.norm(x))
            predictions.append(head(features[-1], start))
            codes = predictions[-1].codes.detach()
            queries = replace(queries, features=x, centers=codes[..., :3], velocities=codes[..., -2:])
        return predictions, features
