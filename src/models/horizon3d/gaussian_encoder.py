"""Gaussian encoder: cross-attention, self-encoding and refinement, which moves Gaussians to objects (Eq. 2-3)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from src.geometry.bev_grid import BEVGrid
from src.geometry.constants import arange
from src.models.horizon3d.anchor_embeddings import JoinedEmbeddings, MergedEmbeddings
from src.models.horizon3d.cross_attention import RadarCrossAttention
from src.models.horizon3d.temporal_attention import TemporalSelfAttention, attention_mask
from src.models.layers.dense import Conv2d
from src.models.layers.doppler import Doppler
from src.models.layers.feed_forward import attention_linear, linear_relu_norm
from src.models.layers.full_precision import FullPrecisionLinear
from src.models.layers.image_attention import ImageCrossAttention
from src.models.layers.norm import layer_norm
from src.models.layers.sparse import SubmanifoldConv
from src.models.layers.views import CameraViews
from src.ops.add_layer_norm import add_layer_norm
from src.ops.cell_keys import cell_keys
from src.ops.fixed_shapes import fixed_shapes
from src.ops.gaussian_shapes import AttributeLimits, activated_attributes, refined_attributes, sampling_points
from src.ops.segment_reduce import segment_mean
from src.ops.sites import Sites
from src.structures.gaussians import GaussianSet
from src.structures.sparse_bev import SparseBEV

FFN_RATIO = 4
DROPOUT = 0.1
SELF_ENCODING_KERNEL = 5
FIXED_POINTS = ((0.0, 0.0), (0.45, 0.0), (-0.45, 0.0), (0.0, 0.45), (0.0, -0.45))
INITIAL_OPACITY = 0.25
RAW_ATTRIBUTES = (0.0, 0.0, 1.0, 0.0, math.log(INITIAL_OPACITY / (1.0 - INITIAL_OPACITY)), 0.0, 0.0)
"""Raw scale 2, rotation 2, opacity 1, velocity 2 of an untrained Gaussian (method 4.4)."""
REFINEMENT_STD = 0.01


@dataclass(frozen=True)
class GaussianBounds(AttributeLimits):
    """Ranges of the attributes; the activations keep to them (method 5.4)."""

    def activate(
        self,
        raw: Tensor,  # [..., 7] scale 2, rotation 2, opacity 1, velocity 2
    ) -> dict[str, Tensor]:
        """Physical attributes by their GaussianSet name, float32; opacity stays a logit."""
        raw = raw.float()
        scales, directions, velocities = activated_attributes(raw, self)
        named = {"scales": scales, "directions": directions, "velocities": velocities}
        return {**named, "opacity_logits": raw[..., 4]}


class AnchorEncoder(nn.Module):
    """Embed the attributes of each Gaussian: a sum of small MLPs, one per attribute, and one more on top.

    Runs in float32: a position of 150 m has steps of half a metre in bfloat16. Training takes `joined`, inference
    `merged`, both of which do the same with fewer launches.
    """

    full_precision_parts = static_parts = ("",)

    def __init__(self, channels: int, grid: BEVGrid, bounds: GaussianBounds) -> None:
        super().__init__()
        self.bounds = bounds
        widths = {"mean": 2, "scale": 2, "direction": 2, "opacity": 1, "velocity": 2}
        self.embed = nn.ModuleDict({name: linear_relu_norm(width, channels) for name, width in widths.items()})
        self.output = linear_relu_norm(channels, channels)
        self.register_buffer("centre_m", torch.tensor(grid.centre_m), persistent=False)
        self.register_buffer("half_extent_m", torch.tensor(grid.half_extent_m), persistent=False)
        self.merged: MergedEmbeddings | None = None

    def merge_for_inference(self) -> None:
        """All attributes are embedded by the same products."""
        self.merged = MergedEmbeddings(list(self.embed.values()), self.output[0])
        self.embed, self.output = None, self.output[2:]

    def joined(self) -> JoinedEmbeddings | None:
        """What `forward` may take to embed all attributes at once, with gradients; once for several sets."""
        return None if self.merged is not None else JoinedEmbeddings.of(list(self.embed.values()))

    def forward(
        self,
        gaussians: GaussianSet,
        joined: JoinedEmbeddings | None = None,
    ) -> Tensor:  # [B, G, C]
        """Embedding of each Gaussian's attributes, e of the layer's equations."""
        with torch.autocast(gaussians.means.device.type, enabled=False):
            inputs = {
                "mean": (gaussians.means - self.centre_m) / self.half_extent_m,
                "scale": gaussians.scales / self.bounds.scale_range_m[1],
                "direction": gaussians.directions,
                "opacity": gaussians.opacity_logits.sigmoid()[..., None],
                "velocity": gaussians.velocities / self.bounds.max_speed_mps,
            }
            if joined is not None:
                return self.output(joined(torch.cat(list(inputs.values()), dim=-1)))
            if self.merged is None:
                return self.output(sum(self.embed[name](value) for name, value in inputs.items()))
            return self.output(self.merged(torch.cat(list(inputs.values()), dim=-1)))


class SelfEncoding(nn.Module):
    """Exchange features among neighbouring Gaussians: mean per occupied cell, two sparse 5x5 convolutions, gather."""

    def __init__(self, channels: int, grid: BEVGrid) -> None:
        super().__init__()
        self.grid = grid
        self.convs = nn.ModuleList(
            SubmanifoldConv(channels, channels, SELF_ENCODING_KERNEL, 2, bias=False) for _ in range(2)
        )
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(2))
        self.output = attention_linear(channels, channels)

    def forward(
        self,
        features: Tensor,  # [B, G, C]
        gaussians: GaussianSet,
        picks: Tensor | None = None,  # [V] int64, `valid_rows` of the Gaussians, where the caller has them
    ) -> Tensor:  # [B, G, C]; zero for padding
        """Exchange the features among neighbours. No gradient reaches the means, which only choose cells."""
        b, g, c = features.shape
        if fixed_shapes() is not None:
            return self._of_all(features, gaussians)
        picks = gaussians.valid_rows() if picks is None else picks
        cells = self.grid.cell_of(gaussians.means.detach().flatten(0, 1).index_select(0, picks))
        sample = torch.div(picks, g, rounding_mode="floor")
        sites, rows = Sites.unique(torch.cat([sample[:, None], cells], dim=1), (b, *self.grid.cells))
        flat = features.flatten(0, 1).index_select(0, picks)  # [V, C]
        x = self._exchange(flat, sites, rows)
        return x.new_zeros(b * g, c).index_copy(0, picks, x).unflatten(0, (b, g))

    def _of_all(self, features: Tensor, gaussians: GaussianSet) -> Tensor:
        """`forward` in fixed shapes: padding counts as Gaussians of a sample that does not exist."""
        valid, (b, g), grid = gaussians.valid, gaussians.valid.shape, self.grid
        lower, size, shape = (grid.x_min_m, grid.y_min_m), (grid.cell_m,) * 2, (b, *grid.cells)
        means, sample = gaussians.means.flatten(0, 1), arange(b, torch.int64, valid.device)
        # One more, which is padding in any case.
        keys = cell_keys(means, sample, valid.flatten(), lower, size, shape, means.dtype, behind=1)
        sites, rows = Sites.unique_keys(keys, shape)
        return self._exchange(features.flatten(0, 1), sites, rows[:-1]).unflatten(0, (b, g)) * valid[..., None]

    def _exchange(
        self,
        features: Tensor,  # [V, C]
        sites: Sites,
        rows: Tensor,  # [V] int64, site of each
    ) -> Tensor:  # [V, C]
        x = SparseBEV(sites, segment_mean(features, rows, len(sites), sites.groups))
        for conv, norm in zip(self.convs, self.norms, strict=True):
            x = conv(x)
            x = x.with_features(layer_norm(norm, x.features, relu=True))
        return self.output(x.features).index_select(0, rows)


class Refinement(nn.Module):
    """New attributes from features (Eq. 3): the mean moves by a bounded step, everything else is regressed anew."""

    static_parts = ("",)

    def __init__(self, channels: int, grid: BEVGrid, bounds: GaussianBounds) -> None:
        super().__init__()
        self.bounds = bounds
        self.trunk = linear_relu_norm(channels, channels)
        self.output = FullPrecisionLinear(channels, 2 + len(RAW_ATTRIBUTES))
        self.output_scale = nn.Parameter(torch.ones(2 + len(RAW_ATTRIBUTES)))
        # Untrained, a Gaussian keeps the position and the attributes that KGGI gives it.
        nn.init.normal_(self.output.weight, std=REFINEMENT_STD)
        with torch.no_grad():
            self.output.bias.copy_(torch.tensor((0.0, 0.0, *RAW_ATTRIBUTES)))
        half = torch.tensor(grid.half_extent_m) - 1e-3 * grid.cell_m  # strictly inside, so that every mean has a cell
        centre = torch.tensor(grid.centre_m)
        self.register_buffer("lower_m", centre - half, persistent=False)
        self.register_buffer("upper_m", centre + half, persistent=False)

    def merge_for_inference(self) -> None:
        """The scale goes into the layer before it."""
        scale, self.output_scale = self.output_scale, None
        self.output.weight.mul_(scale[:, None])
        self.output.bias.mul_(scale)

    def forward(
        self,
        x: Tensor,  # [B, G, C] features + anchor embedding
        gaussians: GaussianSet,
    ) -> GaussianSet:
        """Attributes are float32 also under autocast."""
        raw = self.output(self.trunk(x))
        raw = raw if self.output_scale is None else raw * self.output_scale  # [B, G, 9]
        found = refined_attributes(raw, gaussians.means, self.lower_m, self.upper_m, self.bounds)
        named = dict(zip(("means", "scales", "directions", "velocities"), found, strict=True))
        return replace(gaussians, **named, opacity_logits=raw[..., 6])


class EncoderLayer(nn.Module):
    """One round of attention, self-encoding and refinement (method 5.1, Eq. 2-3)."""

    static_parts = ("feed_forward.0", "feed_forward.1")

    def __init__(
        self,
        channels: int,
        num_learnable_points: int,
        num_views: int,
        num_levels: int,
        grid: BEVGrid,
        bounds: GaussianBounds,
        chained_attention: bool,
        refine_before_self_encoding: bool,
        temporal_heads: int | None,
    ) -> None:
        super().__init__()
        self.temporal_attention = TemporalSelfAttention(channels, temporal_heads) if temporal_heads else None
        num_points = len(FIXED_POINTS) + num_learnable_points
        self.chained_attention = chained_attention
        self.refine_before_self_encoding = refine_before_self_encoding
        self.register_buffer("fixed_points", torch.tensor(FIXED_POINTS), persistent=False)
        self.offsets = attention_linear(channels, 2 * num_learnable_points) if num_learnable_points else None
        self.radar_attention = RadarCrossAttention(channels, num_points, grid)
        self.image_attention = ImageCrossAttention(channels, num_points, num_views, num_levels, grid)
        self.self_encoding = SelfEncoding(channels, grid)
        self.feed_forward = nn.ModuleList(_feed_forward(channels) for _ in range(2))
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(4))
        self.refinement = Refinement(channels, grid, bounds)

    def sampling_points(
        self,
        query: Tensor,  # [B, G, C]
        gaussians: GaussianSet,
    ) -> Tensor:  # [B, G, P, 2] aug metres
        """q_k = m + R(theta) (s * phi_k): fixed and learnable points that follow the Gaussian's shape."""
        offsets = (
            gaussians.means.new_zeros(*query.shape[:2], 0) if self.offsets is None else self.offsets(query).float()
        )
        return sampling_points(offsets, self.fixed_points, gaussians.means, gaussians.scales, gaussians.directions)

    def forward(
        self,
        gaussians: GaussianSet,
        embedding: Tensor,  # [B, G, C] from the anchor encoder
        radar_bev: SparseBEV,
        views: CameraViews,
        values: list[Tensor],  # L x [B, N, C, h, w]
        mask: Tensor | None = None,  # `attention_mask` of the Gaussians, made once for all layers
        picks: Tensor | None = None,  # [V] int64, their `valid_rows`, alike
    ) -> GaussianSet:
        """Features and attributes after this layer."""
        f = gaussians.features
        if self.temporal_attention is not None:
            f = f + self.temporal_attention(f, embedding, gaussians, mask)
        query = f + embedding
        points = self.sampling_points(query, gaussians)
        x = f + self.radar_attention(query, points, radar_bev)
        if self.chained_attention:
            seen = self.image_attention(x, x + embedding, points, views, values)
        else:
            seen = self.image_attention(f, query, points, views, values)
        x = layer_norm(self.norms[0], x, seen)
        x = attended = layer_norm(self.norms[1], x, self.feed_forward[0](x))
        x = layer_norm(self.norms[2], x, self.self_encoding(x, gaussians, picks))
        last = self.norms[3]
        affine, shaped = (last.weight, last.bias), None if self.refine_before_self_encoding else embedding
        x, query = add_layer_norm(x, affine, last.eps, self.feed_forward[1](x), then=shaped)
        refined = self.refinement(attended + embedding if query is None else query, gaussians)
        return replace(refined, features=x)


class GaussianEncoder(nn.Module):
    """L encoder layers with their own weights; anchor encoder and image values are shared."""

    def __init__(
        self,
        channels: int,
        image_channels: int,
        grid: BEVGrid,
        bounds: GaussianBounds,
        num_layers: int,
        make_layer: Callable[[], EncoderLayer],
    ) -> None:
        super().__init__()
        self.anchor = AnchorEncoder(channels, grid, bounds)
        self.image_value = Conv2d(image_channels, channels, 1)
        self.layers = nn.ModuleList(make_layer() for _ in range(num_layers))

    def forward(
        self,
        gaussians: GaussianSet,
        radar_bev: SparseBEV,
        views: CameraViews,
        doppler: Doppler | None = None,
        picks: Tensor | None = None,  # [V] int64, `valid_rows` of the Gaussians, where the caller has them
    ) -> tuple[GaussianSet, Tensor]:
        """G_0 -> G_L; with `doppler` the radial part of their velocities is always the measured one.

        And the velocities [B, G, 2] that losses see.
        """
        values = [
            self.image_value(level.flatten(0, 1)).unflatten(0, level.shape[:2]) for level in views.levels
        ]  # L x [B, N, C, h, w]
        gaussians = _measured(gaussians, doppler)
        temporal = any(layer.temporal_attention is not None for layer in self.layers)
        mask = attention_mask(gaussians.valid, gaussians.features.dtype) if temporal else None
        joined = self.anchor.joined() if torch.is_grad_enabled() else None
        for layer in self.layers:
            embedding = self.anchor(gaussians) if joined is None else self.anchor(gaussians, joined)
            regressed = layer(gaussians, embedding, radar_bev, views, values, mask, picks)
            gaussians = _measured(regressed, doppler)
        in_losses = doppler is None or doppler.config.in_losses
        return gaussians, (gaussians if in_losses else regressed).velocities


def _measured(gaussians: GaussianSet, doppler: Doppler | None) -> GaussianSet:
    """The Gaussians with the radial velocity that the radar measures, where it does (`Doppler.correct`)."""
    if doppler is None:
        return gaussians
    velocities = doppler.correct(gaussians.velocities.flatten(0, 1), gaussians.means.detach())
    return replace(gaussians, velocities=velocities.unflatten(0, gaussians.valid.shape))


def _feed_forward(channels: int) -> nn.Sequential:
    hidden = FFN_RATIO * channels
    return nn.Sequential(
        nn.Linear(channels, hidden), nn.ReLU(), nn.Dropout(DROPOUT), nn.Linear(hidden, channels), nn.Dropout(DROPOUT)
    )
