"""Deformable attention from queries to the images of all views (Eq. 2, method 5.3)."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.geometry.bev_grid import BEVGrid
from src.models.layers.feed_forward import NUM_HEADS, attention_linear, linear_relu_norm
from src.models.layers.views import CameraViews
from src.ops.deform_sample import attend_views, deform_attend_images
from src.ops.view_samples import view_attention_weights, view_sampling_locations

INITIAL_HEIGHT_M = 1.0


class PointOffsets(nn.Linear):
    """Sampling points: a query's place and what it learns to add, untrained at most `reach_m` along each axis."""

    def __init__(self, channels: int, num_points: int, reach_m: float) -> None:
        super().__init__(channels, 3 * num_points)
        nn.init.zeros_(self.weight)
        nn.init.uniform_(self.bias, -reach_m, reach_m)

    def forward(
        self,
        query: Tensor,  # [B, Q, C]
        centers: Tensor,  # [B, Q, 3] aug metres
    ) -> Tensor:  # [B, Q, P, 3]
        """The points, in float32."""
        return centers[:, :, None] + super().forward(query).float().unflatten(-1, (-1, 3))


class ImageCrossAttention(nn.Module):
    """Deformable attention from queries to the image pyramids of all views (DCA_I of Eq. 2).

    The softmax runs jointly over the visible (view, level, point) triples of a query; without any, the result before
    the output layer is exactly zero. With a grid the points lie on the plane and take a height within its band.
    """

    def __init__(
        self, channels: int, num_points: int, num_views: int, num_levels: int, grid: BEVGrid | None = None
    ) -> None:
        super().__init__()
        self.per_view = (NUM_HEADS, num_levels, num_points)
        self.num_views = num_views
        self.height = None
        if grid is not None:
            self.height = attention_linear(channels, num_points)
            low, high = self.z_range_m = grid.z_range_m
            share = min(max((INITIAL_HEIGHT_M - low) / (high - low), 0.01), 0.99)
            nn.init.constant_(self.height.bias, math.log(share / (1.0 - share)))
        self.camera = linear_relu_norm(12, channels)
        self.logits = attention_linear(channels, num_views * math.prod(self.per_view), zero=True)
        self.output = attention_linear(channels, channels)

    def forward(
        self,
        features: Tensor,  # [B, G, C]
        query: Tensor,  # [B, G, C] features + anchor embedding
        points: Tensor,  # [B, G, P, 2] aug metres, [B, G, P, 3] without a grid
        views: CameraViews,
        values: list[Tensor],  # L x [B, N, C, h, w]
        shares: Tensor | None = None,  # [B, G, N, P], what counts of each sample beside its weight; None: all
    ) -> Tensor:  # [B, G, C]
        """Samples of every visible point on every level."""
        if not torch.is_grad_enabled() and points.device.type != "cpu" and self.height is not None and shares is None:
            return self.output(self._gather(features, query, points, views, values).to(values[0].dtype))
        if self.height is not None:
            low, high = self.z_range_m
            z = low + (high - low) * self.height(features).float().sigmoid()  # [B, G, P]
            points = torch.cat([points, z[..., None]], dim=-1)
        pixels, visible = views.project(points)
        weights = self._weights(query, views.pix_from_aug, visible)
        if shares is not None:
            weights = weights * shares[:, :, None, :, None]
        gathered = deform_attend_images(values, pixels, views.image_size_px, weights, visible)
        if torch.is_grad_enabled() and not gathered.requires_grad:
            # Nothing visible: zero gradients rather than none, since DDP expects one per parameter on every rank.
            gathered = gathered + 0.0 * (weights.sum() + pixels.sum() + sum(level.float().sum() for level in values))
        return self.output(gathered.to(values[0].dtype))

    def _gather(
        self, features: Tensor, query: Tensor, points: Tensor, views: CameraViews, values: list[Tensor]
    ) -> Tensor:  # [B, G, C]
        """What `forward` gathers before its output layer; without gradient, in few launches."""
        heights, logits = self.height(features).float(), self.logits(query).float()
        matrix = views.pix_from_aug.float()
        places, visible = view_sampling_locations(
            points, heights, self.z_range_m, matrix, views.valid, views.image_size_px
        )
        weights = view_attention_weights(logits, self._of_cameras(matrix).float(), visible, NUM_HEADS)
        return attend_views([level.float().flatten(0, 1) for level in values], places, weights)

    def _of_cameras(
        self,
        pix_from_aug: Tensor,  # [B, N, 4, 4]
    ) -> Tensor:  # [B, N, heads * L * P]
        """Every view has its own rows of one linear layer on (f + e + cam_n); this is the camera's share."""
        rows = F.normalize(pix_from_aug[:, :, :3].float(), dim=-1)  # pixel-scaled rows would drown the metric one
        camera = self.camera(rows.flatten(2))  # [B, N, C]
        weight = self.logits.weight.unflatten(0, (self.num_views, -1))  # [N, heads*L*P, C]
        return torch.einsum("bnc,nkc->bnk", camera.to(weight.dtype), weight)

    def _weights(
        self,
        query: Tensor,  # [B, G, C]
        pix_from_aug: Tensor,  # [B, N, 4, 4]
        visible: Tensor,  # [B, G, N, P] bool
    ) -> Tensor:  # [B, G, heads, N, L, P], zero where invisible
        logits = self.logits(query).unflatten(-1, (self.num_views, -1))  # [B, G, N, heads*L*P]
        logits = logits + self._of_cameras(pix_from_aug)[:, None]
        logits = logits.float().unflatten(-1, self.per_view).transpose(2, 3)  # [B, G, heads, N, L, P]
        seen = visible[:, :, None, :, None].expand_as(logits)
        logits = logits.masked_fill(~seen, torch.finfo(logits.dtype).min)
        return logits.flatten(3).softmax(-1).view_as(logits) * seen
