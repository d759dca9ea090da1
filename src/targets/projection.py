"""Boxes seen by the cameras: projected centres and clipped 2D hulls, for the camera targets (method 4.3)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from src.geometry.constants import constant
from src.geometry.tensor_transforms import rotate
from src.structures.boxes import Boxes3D

NEAR_M = 0.1
"""Corners closer than this to the image plane have no projection; box edges are cut there."""

CORNERS = ((1, 1), (1, -1), (-1, -1), (-1, 1))
SIGNS = tuple((x, y, z) for z in (-1, 1) for x, y in CORNERS)
EDGES = tuple((i, (i + 1) % 4) for i in range(4)) + tuple((i + 4, (i + 1) % 4 + 4) for i in range(4))
EDGES += tuple((i, i + 4) for i in range(4))


@dataclass
class BoxViews:
    """V (box, view) pairs whose 2D hull meets the image."""

    boxes: Tensor  # [V] int64, row of the box
    views: Tensor  # [V] int64, b * N + n
    centers_px: Tensor  # [V, 2] (u, v) of the 3D centre, possibly outside the image; meaningless at depth <= 0
    depths_m: Tensor  # [V] of the 3D centre along the optical axis, possibly negative
    hulls_px: Tensor  # [V, 4] (u low, v low, u high, v high) of the visible corners, clipped to the image


def view_boxes(
    boxes: Boxes3D,  # K, augmented ego frame
    batch: Tensor,  # [K] int64, sample of each box
    pix_from_aug: Tensor,  # [B, N, 4, 4] float32, rows 0-2 give (u*d, v*d, d)
    image_valid: Tensor,  # [B, N] bool
    image_size_px: tuple[int, int],  # (H, W)
) -> BoxViews:
    """Project boxes into every camera of their sample."""
    num_views = pix_from_aug.shape[1]
    height, width = image_size_px
    pix = pix_from_aug[batch, :, :3]  # [K, N, 3, 4]
    center = _homogeneous(boxes.centers[:, None]) @ pix.transpose(-1, -2)  # [K, N, 1, 3]
    corner = _homogeneous(_corners(boxes)) @ pix.transpose(-1, -2)  # [K, N, 8, 3]
    low, high = _hull(corner)  # [K, N, 2]
    size = constant((width, height), low.dtype, low.device)
    low, high = low.clamp(min=0), torch.minimum(high, size)
    meets = (low < high).all(-1) & image_valid[batch]
    rows, cameras = meets.nonzero(as_tuple=True)
    seen = center[rows, cameras, 0]
    return BoxViews(
        boxes=rows,
        views=batch[rows] * num_views + cameras,
        centers_px=seen[:, :2] / seen[:, 2:].clamp(min=NEAR_M),
        depths_m=seen[:, 2],
        hulls_px=torch.cat([low[rows, cameras], high[rows, cameras]], dim=1),
    )


def _corners(boxes: Boxes3D) -> Tensor:  # [K, 8, 3], the lower four first
    signs = constant(SIGNS, boxes.sizes.dtype, boxes.sizes.device)
    local = 0.5 * signs * boxes.sizes[:, None]
    cos, sin = boxes.yaws.cos()[:, None], boxes.yaws.sin()[:, None]
    along, across, up = local.unbind(-1)
    return boxes.centers[:, None] + torch.stack([*rotate(cos, sin, along, across), up], dim=-1)


def _homogeneous(points: Tensor) -> Tensor:  # [K, q, 3] -> [K, 1, q, 4]
    return torch.cat([points, torch.ones_like(points[..., :1])], dim=-1)[:, None]


def _hull(corners: Tensor) -> tuple[Tensor, Tensor]:  # [K, N, 8, 3] -> low, high [K, N, 2]
    """Bounding rectangle of the part of each box in front of the camera; low > high where nothing is.

    An edge that crosses the near plane contributes the point where it does: without it a truck beside the vehicle
    would shrink to its far end.
    """
    depth = corners[..., 2]
    start, end = constant(EDGES, torch.int64, corners.device).unbind(1)
    share = (NEAR_M - depth[..., start]) / (depth[..., end] - depth[..., start])
    crossing = (depth[..., start] < NEAR_M) != (depth[..., end] < NEAR_M)
    cut = corners[..., start, :] + share[..., None].nan_to_num() * (corners[..., end, :] - corners[..., start, :])
    points = torch.cat([corners[..., :2] / depth[..., None].clamp(min=NEAR_M), cut[..., :2] / NEAR_M], dim=-2)
    seen = torch.cat([depth >= NEAR_M, crossing], dim=-1)[..., None]
    return points.where(seen, torch.inf).amin(-2), points.where(seen, -torch.inf).amax(-2)
