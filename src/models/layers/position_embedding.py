"""PETR's 3D position embedding: what a feature pixel could be looking at, at every depth, told to its feature."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.errors import ConfigError
from src.geometry.bev_grid import BEVGrid
from src.geometry.constants import constant
from src.models.layers.views import CameraViews
from src.targets.depth import DepthBinsConfig, lid_centres

HIDDEN_RATIO = 4
EDGE = 1e-5
"""Normalised coordinates are kept so far from 0 and 1 before their logit is taken: what lies outside says no more."""


@dataclass(kw_only=True)
class PositionEmbeddingConfig(DepthBinsConfig):
    """Settings of the position embedding (`model.position`). Raises ConfigError for values that cannot work."""

    z_range_m: list[float]  # that coordinates are normalised by, with the grid's extent in x and y

    def __post_init__(self) -> None:
        self.check_depth_bins("model.position")
        if len(self.z_range_m) != 2 or not self.z_range_m[0] < self.z_range_m[1]:
            raise ConfigError(f"model.position.z_range_m={self.z_range_m}: must be [low, high] in metres, ascending")


class PositionEmbedding(nn.Module):
    """MLP(normalised D places of the pixel's ray), their logits by default (PETR, Sec. 3.2 and 3.3).

    Runs in float32 also under autocast: places of 150 m would be rounded to half a metre.
    """

    full_precision_parts = ("",)

    def __init__(self, config: PositionEmbeddingConfig, channels: int, grid: BEVGrid, logits: bool = True) -> None:
        super().__init__()
        self.logits = logits
        (x, y), (half_x, half_y) = grid.centre_m, grid.half_extent_m
        low, high = config.z_range_m
        self.low, self.size = (x - half_x, y - half_y, low), (2 * half_x, 2 * half_y, high - low)
        depths = lid_centres(config.depth_range, config.num_depth_bins)
        self.register_buffer("depths_m", depths, persistent=False)
        hidden = HIDDEN_RATIO * channels
        self.mlp = nn.Sequential(nn.Linear(3 * config.num_depth_bins, hidden), nn.ReLU(), nn.Linear(hidden, channels))

    def forward(self, views: CameraViews) -> Tensor:  # [B, N, h, w, C] float32
        """Embedding of every pixel of the finest level; a missing camera's are finite and say nothing."""
        return self.embed(self.places(views))

    def of_points(
        self,
        points: Tensor,  # [B, Q, 3] aug metres
        views: CameraViews,
    ) -> Tensor:  # [B, Q, C] float32
        """Embedding of the pixel that a point is seen at, summed over the views that see it; zero where none does."""
        pixels, visible = views.project(points[:, :, None])  # [B, Q, N, 1, 2], [B, Q, N, 1]
        seen = self.embed(self.on_rays(pixels.squeeze(3), views))  # [B, Q, N, C]
        return torch.where(visible, seen, 0.0).sum(2)

    def embed(self, places: Tensor) -> Tensor:  # [..., D, 3] aug metres -> [..., C]
        """The network on normalised coordinates, or their logits."""
        with torch.autocast(places.device.type, enabled=False):
            low, size = constant((self.low, self.size), torch.float32, places.device)
            shares = (places - low) / size
            return self.mlp((shares.logit(EDGE) if self.logits else shares).flatten(-2))

    def places(self, views: CameraViews) -> Tensor:  # [B, N, h, w, D, 3] aug metres
        """The places at every depth on the ray of each pixel of the finest level."""
        shape = (*views.valid.shape, *views.levels[0].shape[-2:])
        near, far = (views.lift(torch.full(shape, depth, device=views.valid.device)) for depth in (0.0, 1.0))
        return self.between(near, far)

    def on_rays(
        self,
        pixels: Tensor,  # [B, Q, N, 2] (u, v)
        views: CameraViews,
    ) -> Tensor:  # [B, Q, N, D, 3] aug metres
        """The places at every depth on the rays of these pixels."""
        rays = F.pad(pixels, (0, 1), value=1.0)
        near, far = (views.lift_pixels(depth * rays) for depth in (0.0, 1.0))
        return self.between(near, far)

    def between(self, near: Tensor, far: Tensor) -> Tensor:  # [..., 3] at depths 0 and 1 m -> [..., D, 3]
        """The places at every depth on rays, which two places of each determine."""
        return near[..., None, :] + self.depths_m[:, None] * (far - near)[..., None, :]
