"""Where the samples of image attention fall in the views, and what weight each has, without gradient (method 5.3)."""

from __future__ import annotations

import torch
from torch import Tensor

from src.geometry.constants import where_scalar
from src.ops.backend import implementation

MIN_DEPTH_M = 0.5
"""Points nearer to the image plane count as invisible."""
BEYOND = -3.0
"""A place beyond the image, of what is not visible."""


@torch.no_grad()
def view_sampling_locations(
    points: Tensor,  # [B, Q, P, 2] aug metres
    heights: Tensor,  # [B, Q, P] logits of the height within the band
    band_m: tuple[float, float],  # low and high
    pix_from_aug: Tensor,  # [B, N, 4, 4]
    valid: Tensor,  # [B, N] bool, False where the camera is missing
    image_size_px: tuple[int, int],  # (H, W)
) -> tuple[Tensor, Tensor]:  # [B * N, Q, P, 2] in -1..1 of the image, [B, Q, N, P] bool
    """Places of the points in every view as `grid_sample` has them, and whether they are visible there."""
    return implementation(view_sampling_locations_reference)(
        points, heights, band_m, pix_from_aug, valid, image_size_px
    )


def view_sampling_locations_reference(
    points: Tensor,
    heights: Tensor,
    band_m: tuple[float, float],
    pix_from_aug: Tensor,
    valid: Tensor,
    image_size_px: tuple[int, int],
) -> tuple[Tensor, Tensor]:
    """Plain torch form."""
    low, high = band_m
    z = low + (high - low) * heights.sigmoid()
    lifted = torch.cat([points, z[..., None], torch.ones_like(z)[..., None]], dim=-1)  # [B, Q, P, 4]
    matrix = pix_from_aug[:, None, :, None, :3]  # [B, 1, N, 1, 3, 4]
    x, y, depth = (matrix * lifted[:, :, None, :, None]).sum(-1).unbind(-1)  # [B, Q, N, P] each
    safe = depth.clamp(min=MIN_DEPTH_M)
    height, width = image_size_px
    u, v = x / safe, y / safe
    visible = (u >= 0) & (v >= 0) & (u < width) & (v < height) & (depth > MIN_DEPTH_M) & valid[:, None, :, None]
    places = torch.stack([2 * (u / width) - 1, 2 * (v / height) - 1], dim=-1)
    return where_scalar(visible[..., None], places, BEYOND).transpose(1, 2).flatten(0, 1), visible


@torch.no_grad()
def view_attention_weights(
    logits: Tensor,  # [B, Q, N * heads * L * P] of the queries
    camera: Tensor,  # [B, N, heads * L * P] of the cameras, added to them
    visible: Tensor,  # [B, Q, N, P] bool
    heads: int,
) -> Tensor:  # [B, Q, heads, N, L, P]
    """Softmax over the visible (view, level, point) triples of every query and head; zero where invisible."""
    return implementation(view_attention_weights_reference)(logits, camera, visible, heads)


def view_attention_weights_reference(logits: Tensor, camera: Tensor, visible: Tensor, heads: int) -> Tensor:
    """Plain torch form."""
    summed = logits.unflatten(-1, camera.shape[1:]) + camera[:, None]  # [B, Q, N, heads * L * P]
    summed = summed.unflatten(-1, (heads, -1, visible.shape[3])).transpose(2, 3)  # [B, Q, heads, N, L, P]
    seen = visible[:, :, None, :, None].expand_as(summed)
    summed = summed.masked_fill(~seen, torch.finfo(summed.dtype).min)
    return summed.flatten(3).softmax(-1).view(summed.shape) * seen
