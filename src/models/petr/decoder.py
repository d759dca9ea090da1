"""PETR's decoder: queries look at one another and at all pixels of all cameras; the embedding tells them where."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.errors import ConfigError, require_least
from src.geometry.bev_grid import BEVGrid
from src.models.heads.query_head import QueryPrediction, SetPredictionHead
from src.models.layers.image_attention import attention_linear
from src.models.layers.query_attention import QueryEmbedding
from src.structures.queries import Queries

FFN_RATIO = 8
"""2,048 of 256 channels."""


@dataclass(kw_only=True)
class PETRDecoderConfig:
    """Settings of the decoder (`model.decoder`). Raises ConfigError for values that cannot work."""

    num_layers: int
    num_heads: int

    def __post_init__(self) -> None:
        require_least(self, "model.decoder", {"num_layers": 1, "num_heads": 1})


class GlobalAttention(nn.Module):
    """Multi-head attention to all keys that are valid; a sample without any gets zeros before the output layer."""

    def __init__(self, channels: int, num_heads: int) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.query, self.key, self.value, self.output = (attention_linear(channels, channels) for _ in range(4))

    def forward(
        self,
        query: Tensor,  # [B, Q, C]
        key: Tensor,  # [B, G, C]
        value: Tensor,  # [B, G, C]
        valid: Tensor,  # [B, G] bool
    ) -> Tensor:  # [B, Q, C]
        """What each query gathers."""
        split = (self.num_heads, -1)
        parts = (layer(x) for layer, x in ((self.query, query), (self.key, key), (self.value, value)))
        heads = (x.unflatten(-1, split).transpose(1, 2) for x in parts)
        some = valid.any(1)[:, None]
        gathered = F.scaled_dot_product_attention(*heads, attn_mask=(valid | ~some)[:, None, None])
        return self.output(gathered.transpose(1, 2).flatten(2) * some[..., None])


class PETRDecoderLayer(nn.Module):
    """Self-attention, attention to the images and an MLP, each added and normalised (DETR's order)."""

    def __init__(self, channels: int, num_heads: int) -> None:
        super().__init__()
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(3))
        self.self_attention = GlobalAttention(channels, num_heads)
        self.image_attention = GlobalAttention(channels, num_heads)
        hidden = FFN_RATIO * channels
        self.mlp = nn.Sequential(nn.Linear(channels, hidden), nn.ReLU(), nn.Linear(hidden, channels))

    def forward(
        self,
        queries: Queries,
        embedding: Tensor,  # [B, Q, C]
        past: tuple[Tensor, Tensor, Tensor] | None,  # further keys [B, n, C], values [B, n, C], valid [B, n]
        images: tuple[Tensor, Tensor, Tensor],  # keys [B, G, C], values [B, G, C], valid [B, G]
    ) -> Tensor:  # [B, Q, C]
        """The queries' features after this layer."""
        x = queries.features
        own = (x + embedding, x, queries.valid)
        if past is not None:
            own = tuple(torch.cat([one, two.to(one.dtype)], dim=1) for one, two in zip(own, past, strict=True))
        x = self.norms[0](x + self.self_attention(x + embedding, *own))
        x = self.norms[1](x + self.image_attention(x + embedding, *images))
        return self.norms[2](x + self.mlp(x))


class PETRDecoder(nn.Module):
    """Every layer predicts relative to the anchors that its queries began with: none is moved on the way."""

    def __init__(self, config: PETRDecoderConfig, channels: int, grid: BEVGrid) -> None:
        super().__init__()
        if channels % config.num_heads:
            raise ConfigError(f"model.decoder.num_heads={config.num_heads}: must divide model.channels={channels}")
        self.embedding = QueryEmbedding(channels, grid)
        self.layers = nn.ModuleList(PETRDecoderLayer(channels, config.num_heads) for _ in range(config.num_layers))

    def forward(
        self,
        queries: Queries,
        past: Queries | None,  # further ones to look at
        images: tuple[Tensor, Tensor, Tensor],  # keys [B, G, C], values [B, G, C], valid [B, G]
        head: SetPredictionHead,
    ) -> tuple[list[QueryPrediction], Tensor]:  # of each layer, [B, Q, C]
        """What every layer predicts, and the features that the last one predicts from."""
        embedding = self.embedding(queries)
        remembered = None
        if past is not None:
            remembered = (past.features + self.embedding(past), past.features, past.valid)
        predictions = []
        for layer in self.layers:
            queries = replace(queries, features=layer(queries, embedding, remembered, images))
            predictions.append(head(queries.features, queries))
        return predictions, queries.features
