"""Far3D's decoder: queries gather from every level of every view at points around them, aware of the cameras."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.errors import require_least
from src.geometry.bev_grid import BEVGrid
from src.models.heads.query_head import QueryPrediction, SetPredictionHead
from src.models.layers.dense import Conv2d
from src.models.layers.feed_forward import feed_forward, scale_shift_linear
from src.models.layers.global_attention import FFN_RATIO, GlobalAttention
from src.models.layers.image_attention import ImageCrossAttention, PointOffsets
from src.models.layers.query_attention import QueryEmbedding, check_decoder_heads
from src.models.layers.views import CameraViews
from src.structures.queries import Queries

INITIAL_REACH_M = 2.0
"""Untrained, the sampling points lie within this distance of their query along each axis (public code)."""


@dataclass(kw_only=True)
class PerspectiveDecoderConfig:
    """Settings of the decoder (`model.decoder`). Raises ConfigError for values that cannot work."""

    num_layers: int
    num_heads: int  # of the self-attention
    num_points: int  # sampling points of a query

    def __post_init__(self) -> None:
        require_least(self, "model.decoder", {"num_layers": 1, "num_heads": 1, "num_points": 1})


class CameraScaling(nn.Module):
    """Scale and shift of a view's features that follow from its camera; untrained, it leaves them as they are."""

    full_precision_parts = ("hidden", "scale_shift")

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.hidden, self.scale_shift = nn.Linear(12, channels), scale_shift_linear(channels)

    def forward(
        self,
        level: Tensor,  # [B, N, C, h, w]
        pix_from_aug: Tensor,  # [B, N, 4, 4]
    ) -> Tensor:  # [B, N, C, h, w]
        with torch.autocast(level.device.type, enabled=False):
            rows = F.normalize(pix_from_aug[:, :, :3].float(), dim=-1).flatten(2)  # as `ImageCrossAttention` reads it
            scale, shift = self.scale_shift(F.relu(self.hidden(rows)))[..., None, None].to(level.dtype).chunk(2, dim=2)
        return level * scale + shift


class PerspectiveLayer(nn.Module):
    """Self-attention, perspective-aware aggregation and an MLP, each added and normalised.

    Aggregation: points in 3D around the query, learnt from it, are projected into all views; their samples on all
    levels are summed by weights that query and camera give.
    """

    def __init__(self, config: PerspectiveDecoderConfig, channels: int, num_views: int, num_levels: int) -> None:
        super().__init__()
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(3))
        self.self_attention = GlobalAttention(channels, config.num_heads)
        self.offsets = PointOffsets(channels, config.num_points, INITIAL_REACH_M)
        self.image_attention = ImageCrossAttention(channels, config.num_points, num_views, num_levels)
        self.mlp = feed_forward(channels, FFN_RATIO)

    def forward(
        self,
        queries: Queries,
        embedding: Tensor,  # [B, Q, C]
        past: tuple[Tensor, Tensor, Tensor] | None,  # further keys [B, n, C], values [B, n, C], valid [B, n]
        views: CameraViews,
        values: list[Tensor],  # L x [B, N, C, h, w]
    ) -> Tensor:  # [B, Q, C]
        """The queries' features after this layer."""
        x = queries.features
        x = self.norms[0](x + self.self_attention.among(queries, embedding, past))
        query = x + embedding
        points = self.offsets(query, queries.centers)
        x = self.norms[1](x + self.image_attention(x, query, points, views, values))
        return self.norms[2](x + self.mlp(x))


class PerspectiveDecoder(nn.Module):
    """Every layer looks around the places that its queries began at and predicts relative to them."""

    def __init__(
        self,
        config: PerspectiveDecoderConfig,
        channels: int,
        image_channels: int,
        num_views: int,
        num_levels: int,
        grid: BEVGrid,
    ) -> None:
        super().__init__()
        check_decoder_heads(config.num_heads, channels)
        self.embedding = QueryEmbedding(channels, grid)
        self.scaling = CameraScaling(image_channels)
        self.image_value = Conv2d(image_channels, channels, 1)
        sizes = (channels, num_views, num_levels)
        self.layers = nn.ModuleList(PerspectiveLayer(config, *sizes) for _ in range(config.num_layers))

    def forward(
        self,
        queries: Queries,
        past: Queries | None,  # further ones to look at
        views: CameraViews,
        head: SetPredictionHead,
    ) -> tuple[list[QueryPrediction], list[Tensor]]:  # of each layer, and [B, Q, C]
        """What every layer predicts, and the features that it predicts from."""
        scaled = [self.scaling(level, views.pix_from_aug) for level in views.levels]
        values = [self.image_value(x.flatten(0, 1)).unflatten(0, x.shape[:2]) for x in scaled]
        embeddings = (self.embedding(queries), None if past is None else self.embedding(past))
        return head.of_layers(self.layers, queries, past, embeddings, views, values)
