"""Attention of object queries to what is near them, and the embedding of where they are."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.errors import ConfigError
from src.geometry.bev_grid import BEVGrid
from src.geometry.constants import constant
from src.models.layers.feed_forward import attention_linear
from src.structures.queries import Queries
from src.structures.taxonomy import SPEED_UNIT_MPS

OFFSET_UNIT_M = 4.0
FREQUENCIES = 7
"""Frequencies of the sine embedding, in octaves: the shortest period is 1/64 of the range, 4.8 m of 307 m."""
PENALTY_RANGE = (-2.0, 1.0)
"""Heads start with penalties of softplus(-2) = 0.13 to softplus(1) = 1.3 per metre."""


def check_decoder_heads(num_heads: int, channels: int) -> None:
    """Raises ConfigError for heads (`model.decoder.num_heads`) that do not divide the channels."""
    if channels % num_heads:
        raise ConfigError(f"model.decoder.num_heads={num_heads}: must divide model.channels={channels}")


class SinePositionEmbedding(nn.Module):
    """Sines of places, and what else is told of each, by an MLP; in float32, since autocast would round 150 m."""

    full_precision_parts = ("",)

    def __init__(self, channels: int, grid: BEVGrid, extra: int = 0, coordinates: int = 3) -> None:
        super().__init__()
        (low, high), (x, y) = grid.z_range_m, grid.half_extent_m
        self.middle = (*grid.centre_m, 0.5 * (low + high))[:coordinates]
        self.half = (x, y, 0.5 * (high - low))[:coordinates]
        inputs = coordinates * 2 * FREQUENCIES + extra
        self.mlp = nn.Sequential(nn.Linear(inputs, channels), nn.ReLU(), nn.Linear(channels, channels))

    def forward(
        self,
        places: Tensor,  # [..., coordinates] m; further coordinates are left out
        *extra: Tensor,  # [..., n] each
    ) -> Tensor:  # [..., C]
        with torch.autocast(places.device.type, enabled=False):
            middle, half = constant((self.middle, self.half), torch.float32, places.device)
            octaves = math.pi * 2.0 ** torch.arange(FREQUENCIES, device=places.device)
            shares = (places[..., : len(self.half)].float() - middle) / half
            phase = (shares[..., None] * octaves).flatten(-2)  # [..., coordinates * frequencies]
            return self.mlp(torch.cat([phase.sin(), phase.cos(), *(value.float() for value in extra)], dim=-1))


class QueryEmbedding(SinePositionEmbedding):
    """Sines of a query's place, and its velocity."""

    def __init__(self, channels: int, grid: BEVGrid) -> None:
        super().__init__(channels, grid, extra=2)

    def forward(self, queries: Queries) -> Tensor:  # [B, Q, C]
        """Embedding of every query."""
        return super().forward(queries.centers, queries.velocities.float() / SPEED_UNIT_MPS)


class DistanceAttention(nn.Module):
    """Multi-head attention to the nearest keys, whose scores fall off with their distance.

    softmax_k(q k / sqrt(c) - tau d) (v + W offset) over the `count` keys nearest in x and y, with the penalty
    tau = softplus(w [q, log(1 + range)]) of every head in 1/m: a query sets its own reach, and so does its range. A
    query without any key gets zeros before the output layer.
    """

    def __init__(self, channels: int, num_heads: int, count: int) -> None:
        super().__init__()
        self.num_heads, self.count = num_heads, count
        self.query = attention_linear(channels, channels)
        self.key_value = attention_linear(channels, 2 * channels)
        self.offset = nn.Linear(3, channels)
        self.penalty = attention_linear(channels + 1, num_heads, zero=True)
        with torch.no_grad():
            self.penalty.bias.copy_(torch.linspace(*PENALTY_RANGE, num_heads))
        self.output = attention_linear(channels, channels)

    def forward(
        self,
        query: Tensor,  # [B, Q, C]
        centers: Tensor,  # [B, Q, 3] m
        keys: Tensor,  # [B, G, C]
        key_centers: Tensor,  # [B, G, 3] m
        valid: Tensor,  # [B, G] bool, or [B, Q, G] of each query
    ) -> Tensor:  # [B, Q, C]
        """What each query gathers; keys that are not valid are padding."""
        picks, seen = self.nearest(centers, key_centers, valid)  # [B, Q, K] each
        rows = picks + keys.shape[1] * torch.arange(len(keys), device=keys.device)[:, None, None]
        key, value = (F.embedding(rows, part.flatten(0, 1)) for part in self.key_value(keys).chunk(2, dim=-1))
        offsets = F.embedding(rows, key_centers.flatten(0, 1)) - centers[:, :, None]  # [B, Q, K, 3]
        value = value + self.offset((offsets / OFFSET_UNIT_M).to(value.dtype))
        split = (self.num_heads, -1)
        parts = (self.query(query)[:, :, None].unflatten(-1, split), key.unflatten(-1, split))
        scores = (parts[0] * parts[1]).sum(-1).float() / math.sqrt(parts[0].shape[-1])  # [B, Q, K, heads]
        distance = offsets[..., :2].norm(dim=-1, keepdim=True)
        scores = scores - self.penalties(query, centers)[:, :, None] * distance
        scores = scores.masked_fill(~seen[..., None], torch.finfo(scores.dtype).min)
        weights = (scores.softmax(2) * seen[..., None]).to(value.dtype)
        return self.output((weights[..., None] * value.unflatten(-1, split)).sum(2).flatten(2))

    def penalties(self, query: Tensor, centers: Tensor) -> Tensor:  # [B, Q, heads] 1/m
        """tau of every head."""
        reach = centers[..., :2].norm(dim=-1, keepdim=True).log1p().to(query.dtype)
        return F.softplus(self.penalty(torch.cat([query, reach], dim=-1)).float())

    @torch.no_grad()
    def nearest(
        self, centers: Tensor, key_centers: Tensor, valid: Tensor
    ) -> tuple[Tensor, Tensor]:  # [B, Q, K] int64, [B, Q, K] bool
        """The keys nearest to each query, nearest first, and which of them exist."""
        exact = "donot_use_mm_for_euclid_dist"  # the difference of squares would be wrong by decimetres at 150 m
        apart = torch.cdist(centers[..., :2].float(), key_centers[..., :2].float(), compute_mode=exact)
        apart = apart.masked_fill(~(valid if valid.dim() == 3 else valid[:, None]), torch.inf)
        distance, picks = apart.topk(min(self.count, apart.shape[2]), dim=2, largest=False)
        return picks, distance.isfinite()
