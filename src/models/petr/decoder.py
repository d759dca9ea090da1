"""PETR's decoder: queries look at one another and at all pixels of all cameras; the embedding tells them where."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor, nn

from src.errors import require_least
from src.geometry.bev_grid import BEVGrid
from src.models.heads.query_head import QueryPrediction, SetPredictionHead
from src.models.layers.global_attention import GlobalDecoderLayer
from src.models.layers.query_attention import QueryEmbedding, check_decoder_heads
from src.structures.queries import Queries


@dataclass(kw_only=True)
class PETRDecoderConfig:
    """Settings of the decoder (`model.decoder`). Raises ConfigError for values that cannot work."""

    num_layers: int
    num_heads: int

    def __post_init__(self) -> None:
        require_least(self, "model.decoder", {"num_layers": 1, "num_heads": 1})


class PETRDecoder(nn.Module):
    """Every layer predicts relative to the anchors that its queries began with: none is moved on the way."""

    def __init__(self, config: PETRDecoderConfig, channels: int, grid: BEVGrid) -> None:
        super().__init__()
        check_decoder_heads(config.num_heads, channels)
        self.embedding = QueryEmbedding(channels, grid)
        self.layers = nn.ModuleList(GlobalDecoderLayer(channels, config.num_heads) for _ in range(config.num_layers))
        self.norm = nn.LayerNorm(channels)

    def forward(
        self,
        queries: Queries,
        past: Queries | None,  # further ones to look at
        images: tuple[Tensor, Tensor, Tensor],  # keys [B, G, C], values [B, G, C], valid [B, G]
        head: SetPredictionHead,
    ) -> tuple[list[QueryPrediction], list[Tensor]]:  # of each layer, and [B, Q, C]
        """What every layer predicts, and the features that it predicts from."""
        embeddings = (self.embedding(queries), None if past is None else self.embedding(past))
        return head.of_layers(self.layers, queries, past, embeddings, images, norm=self.norm)
