"""RCTrans' radar dense encoder: a U-Net that fills the cells between sparse pillars, with attention at its bottom."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from src.errors import ConfigError, require_least
from src.geometry.bev_grid import BEVGrid
from src.models.layers.dense import DenseConvNormReLU, map_of_rows, rows_of_map
from src.models.layers.feed_forward import feed_forward
from src.models.layers.global_attention import GlobalAttention
from src.models.layers.query_attention import SinePositionEmbedding

DOWNS = 3
"""Halvings of the map, each with twice the channels (public code: 64 to 512)."""
FFN_RATIO = 2
"""1,024 of 512 channels (public code)."""


@dataclass(kw_only=True)
class DensifierConfig:
    """Settings of the radar dense encoder (`model.densifier`). Raises ConfigError for values that cannot work."""

    channels: int  # at full resolution, which is also the width of the dense map
    num_layers: int  # of self-attention at the coarsest level
    num_heads: int

    def __post_init__(self) -> None:
        require_least(self, "model.densifier", {"channels": 1, "num_layers": 0, "num_heads": 1})
        if self.channels * 2**DOWNS % self.num_heads:
            raise ConfigError(
                f"model.densifier.num_heads={self.num_heads}: must divide the coarsest level's "
                f"{self.channels * 2**DOWNS} channels"
            )


class CellAttention(nn.Module):
    """Every cell of a map looks at all of them: self-attention and an MLP, each added and normalised."""

    def __init__(self, channels: int, num_heads: int, grid: BEVGrid) -> None:
        super().__init__()
        self.embedding = SinePositionEmbedding(channels, grid, coordinates=2)
        self.attention = GlobalAttention(channels, num_heads)
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(2))
        self.mlp = feed_forward(channels, FFN_RATIO)

    def forward(
        self,
        x: Tensor,  # [B, n, C]
        places: Tensor,  # [n, 2] m
    ) -> Tensor:  # [B, n, C]
        """The cells' features after this layer; keys and values hold the embedding as queries do."""
        placed = x + self.embedding(places)
        every = torch.ones(x.shape[:2], dtype=torch.bool, device=x.device)
        x = self.norms[0](x + self.attention(placed, placed, placed, every))
        return self.norms[1](x + self.mlp(x))


class RadarDensifier(nn.Module):
    """Down by max pooling, attention added at the bottom, up by transposed convolutions beside the finer levels.

    Two 3x3 convolutions with batch norm and ReLU at every level on both ways. Raises ConfigError for a grid that
    cannot be halved so often.
    """

    def __init__(self, config: DensifierConfig, in_channels: int, grid: BEVGrid) -> None:
        super().__init__()
        if any(size % 2**DOWNS for size in grid.cells):
            raise ConfigError(
                f"grid.cells and model.pillar_cells give {grid.rows} x {grid.cols} pillars: each must be a multiple of "
                f"{2**DOWNS}, which the radar dense encoder halves away"
            )
        widths = [config.channels * 2**level for level in range(DOWNS + 1)]
        self.grid, self.cells = grid, (grid.rows // 2**DOWNS, grid.cols // 2**DOWNS)
        self.down = nn.ModuleList(map(two_convolutions, [in_channels, *widths], widths))
        bottom = BEVGrid(self.cells, grid.cell_m * 2**DOWNS, grid.centre_m, grid.z_range_m)
        places = torch.cartesian_prod(*map(torch.arange, self.cells))
        self.register_buffer("places_m", bottom.centre_of(places), persistent=False)
        self.attention = nn.ModuleList(
            CellAttention(widths[-1], config.num_heads, bottom) for _ in range(config.num_layers)
        )
        self.raise_ = nn.ModuleList(nn.ConvTranspose2d(2 * width, width, 2, 2) for width in reversed(widths[:-1]))
        self.up = nn.ModuleList(two_convolutions(2 * width, width) for width in reversed(widths[:-1]))

    def forward(
        self,
        x: Tensor,  # [B, C_in, rows, cols], zero where no point fell
    ) -> Tensor:  # [B, C, rows, cols]
        """The dense map."""
        levels = [self.down[0](x)]
        for down in self.down[1:]:
            levels.append(down(nn.functional.max_pool2d(levels[-1], 2)))
        x = levels.pop()
        shape = (len(x), *self.cells)
        cells = rows_of_map(x).unflatten(0, (len(x), -1))  # [B, n, C]
        for attention in self.attention:
            cells = attention(cells, self.places_m)
        if len(self.attention):
            x = x + map_of_rows(cells.flatten(0, 1), shape)
        for raised, up in zip(self.raise_, self.up, strict=True):
            x = up(torch.cat([levels.pop(), raised(x)], dim=1))
        return x


def two_convolutions(in_channels: int, channels: int) -> nn.Sequential:
    """3x3, batch norm, ReLU, twice."""
    return nn.Sequential(DenseConvNormReLU(in_channels, channels, 3), DenseConvNormReLU(channels, channels, 3))
