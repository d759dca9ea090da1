"""Attention to everything there is, and the decoder layer of queries that is made of it (DETR, PETR)."""

from __future__ import annotations

from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.models.layers.feed_forward import attention_linear, feed_forward
from src.structures.queries import Queries

FFN_RATIO = 8
"""2,048 of 256 channels."""


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
        valid: Tensor,  # [B, G] bool, or [B, Q, G] of each query
    ) -> Tensor:  # [B, Q, C]
        """What each query gathers."""
        split = (self.num_heads, -1)
        parts = (layer(x) for layer, x in ((self.query, query), (self.key, key), (self.value, value)))
        heads = (x.unflatten(-1, split).transpose(1, 2) for x in parts)
        valid = valid if valid.dim() == 3 else valid[:, None]
        some = valid.any(2, keepdim=True)
        gathered = F.scaled_dot_product_attention(*heads, attn_mask=(valid | ~some)[:, None])
        return self.output(gathered.transpose(1, 2).flatten(2) * some)

    def among(
        self,
        queries: Queries,
        embedding: Tensor,  # [B, Q, C]
        past: tuple[Tensor, Tensor, Tensor] | None,  # further keys [B, n, C], values [B, n, C], valid [B, n]
    ) -> Tensor:  # [B, Q, C]
        """What queries gather from one another and from the past; keys hold their embedding, values do not."""
        values, further = queries.features, None
        keys = query = values + embedding
        if past is not None:
            *past, further = past
            keys, values = (
                torch.cat([one, two.to(one.dtype)], dim=1) for one, two in zip((keys, values), past, strict=True)
            )
        return self(query, keys, values, queries.seen(further))


class GlobalDecoderLayer(nn.Module):
    """Self-attention, attention to the tokens of a sensor and an MLP, each of normalised features, and added to them.

    DETR normalises the sums instead; what all queries gather alike can then outgrow what tells them apart.
    """

    def __init__(self, channels: int, num_heads: int) -> None:
        super().__init__()
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(3))
        self.self_attention = GlobalAttention(channels, num_heads)
        self.cross_attention = GlobalAttention(channels, num_heads)
        self.mlp = feed_forward(channels, FFN_RATIO)

    def forward(
        self,
        queries: Queries,
        embedding: Tensor,  # [B, Q, C]
        past: tuple[Tensor, Tensor, Tensor] | None,  # further keys [B, n, C], values [B, n, C], valid [B, n]
        tokens: tuple[Tensor, ...],  # as `cross_attention` takes them: keys [B, G, C], values [B, G, C], valid [B, G]
    ) -> Tensor:  # [B, Q, C]
        """The queries' features after this layer, not normalised."""
        x = queries.features
        x = x + self.self_attention.among(replace(queries, features=self.norms[0](x)), embedding, past)
        x = x + self.cross_attention(self.norms[1](x) + embedding, *tokens)
        return x + self.mlp(self.norms[2](x))
