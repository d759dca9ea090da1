"""Radar points to features of occupied cells: a point network, then attention along space-filling curves (PTv3)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.errors import ConfigError, require_least
from src.geometry.bev_grid import BEVGrid
from src.models.backbones.pillars import PillarConfig, PillarEncoder
from src.models.layers.feed_forward import feed_forward
from src.models.layers.sparse import SubmanifoldConv
from src.ops.segment_reduce import segment_count, topk_per_sample
from src.ops.sites import Sites
from src.structures.sparse_bev import SparseBEV

MLP_RATIO = 2
CURVE_BITS = 16


@dataclass(kw_only=True)
class PointTransformerConfig(PillarConfig):
    """Settings of the radar encoder (`model.radar_encoder`). Raises ConfigError for values that cannot work."""

    num_blocks: int  # of attention; they alternate between two curves
    num_heads: int
    patch_size: int  # neighbours along the curve that attend to one another

    def __post_init__(self) -> None:
        super().__post_init__()
        require_least(self, "model.radar_encoder", {"num_blocks": 0, "num_heads": 1, "patch_size": 2})
        if self.channels % self.num_heads:
            raise ConfigError(
                f"model.radar_encoder.num_heads={self.num_heads}: must divide "
                f"model.radar_encoder.channels={self.channels}"
            )


@dataclass
class PaddedPoints:
    """The points of B samples side by side, padded to the most that one has."""

    features: Tensor  # [B, G, C]
    xyz: Tensor  # [B, G, 3] m, aug frame
    valid: Tensor  # [B, G] bool


@dataclass
class RadarPoints:
    """Points of a radar, one for every occupied cell."""

    bev: SparseBEV  # M cells with the features of their points
    means: Tensor  # [M, 7] mean of the cell's points: x, y, z (m, aug frame), rcs (dB), vx, vy (m/s), dt (s)

    def with_features(self, features: Tensor) -> RadarPoints:
        """The same points with other features [M, C']."""
        return replace(self, bev=self.bev.with_features(features))

    def padded(self) -> PaddedPoints:
        """The points of each sample in a row of their own. Synchronises with a GPU once."""
        sample, batch_size = self.bev.indices[:, 0], self.bev.batch_size
        longest = int(segment_count(sample, batch_size).max())
        rows = topk_per_sample(self.means.new_zeros(len(sample)), sample, batch_size, longest)  # in their order
        valid = rows >= 0
        picks = torch.where(valid, rows, len(sample))  # one more row, which padding reads
        features, xyz = (F.pad(table, (0, 0, 0, 1)) for table in (self.bev.features, self.means[:, :3]))
        return PaddedPoints(F.embedding(picks, features), F.embedding(picks, xyz), valid)


class PointTransformer(nn.Module):
    """Point Transformer V3's way at one resolution: points are pooled into cells, put into the order of a space-filling
    curve, and attend to one another within consecutive patches of it.

    Cells are those of the grid and are encoded by the point network of `PillarEncoder`; the order alternates between
    the Z curve and its transpose. Its stages of coarser cells are left out.
    """

    def __init__(self, config: PointTransformerConfig, grid: BEVGrid) -> None:
        super().__init__()
        self.grid, self.channels = grid, config.channels
        self.pillars = PillarEncoder(config, grid)
        sizes = (config.channels, config.num_heads, config.patch_size)
        self.blocks = nn.ModuleList(SerialisedBlock(*sizes, number % 2 == 1) for number in range(config.num_blocks))

    def forward(
        self,
        radar_points: Tensor,  # [P, 7] x, y, z (m, aug frame), rcs (dB), vx, vy (m/s), dt (s)
        radar_batch: Tensor,  # [P] int64 sample of each point
        batch_size: int,
    ) -> RadarPoints:
        """Points outside the grid or its height band are left out."""
        features, cells, means = self.pillars.encode(radar_points, radar_batch)
        bev = SparseBEV(Sites.from_linear(cells, (batch_size, self.grid.rows, self.grid.cols)), features)
        for block in self.blocks:
            bev = block(bev)
        return RadarPoints(bev, means)


class SerialisedBlock(nn.Module):
    """Positions by a convolution, attention within patches of a curve, and an MLP, each added (PTv3's block)."""

    def __init__(self, channels: int, num_heads: int, patch_size: int, transposed: bool) -> None:
        super().__init__()
        self.num_heads, self.patch_size, self.transposed = num_heads, patch_size, transposed
        self.position = SubmanifoldConv(channels, channels, 3, 2, bias=True)
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(2))
        self.query_key_value = nn.Linear(channels, 3 * channels)
        self.output = nn.Linear(channels, channels)
        self.mlp = feed_forward(channels, MLP_RATIO)

    def forward(self, bev: SparseBEV) -> SparseBEV:
        x = bev.features + self.position(bev).features
        x = x + self.attend(self.norms[0](x), self.patches(bev))
        return bev.with_features(x + self.mlp(self.norms[1](x)))

    def patches(
        self,
        bev: SparseBEV,
    ) -> Tensor:  # [patches, patch_size] int64 row of `bev`, -1 at the end of a sample's last one
        """Consecutive cells of each sample along the curve."""
        sample, row, col = bev.indices.unbind(1)
        curve = z_order(col, row) if self.transposed else z_order(row, col)
        order = ((sample << (2 * CURVE_BITS)) | curve).argsort()
        counts = segment_count(sample, bev.batch_size)
        wanted = torch.div(counts + self.patch_size - 1, self.patch_size, rounding_mode="floor")
        begin = (wanted.cumsum(0) - wanted) * self.patch_size - (counts.cumsum(0) - counts)  # of a sample, less its row
        rows = order.new_full((int(wanted.sum()) * self.patch_size,), -1)
        rows[torch.arange(len(order), device=order.device) + begin[sample]] = order  # `sample` ascends in both orders
        return rows.view(-1, self.patch_size)

    def attend(
        self,
        x: Tensor,  # [M, C]
        patches: Tensor,  # [n, patch_size] int64
    ) -> Tensor:  # [M, C]
        """Multi-head attention of every row to those of its patch."""
        places, rows = (patches.flatten() >= 0).nonzero().squeeze(1), patches.flatten()
        spread = x.new_zeros(len(rows), x.shape[1]).index_copy(0, places, x[rows[places]])
        split = (*patches.shape, 3, self.num_heads, x.shape[1] // self.num_heads)
        heads = self.query_key_value(spread).view(split).permute(2, 0, 3, 1, 4)  # q, k, v of [n, heads, patch, c]
        mask = (patches >= 0)[:, None, None]
        attended = F.scaled_dot_product_attention(*heads, attn_mask=mask).transpose(1, 2).flatten(2).flatten(0, 1)
        back = torch.empty_like(places).index_copy(0, rows[places], places)
        return self.output(attended[back])


def z_order(
    high: Tensor,  # [n] int64, 0..65535
    low: Tensor,  # [n] int64, 0..65535
) -> Tensor:  # [n] int64
    """Place on the Z curve (Morton code): the bits of both numbers by turns, `high` first."""
    code = torch.zeros_like(high)
    for bit in range(CURVE_BITS):
        code |= (high >> bit & 1) << (2 * bit + 1) | (low >> bit & 1) << (2 * bit)
    return code
