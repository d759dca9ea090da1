"""How far points are from rotated boxes, and which lie inside."""

from __future__ import annotations

import torch
from torch import Tensor

from src.geometry.tensor_transforms import rotate_back


def footprint_distances(
    points: Tensor,  # [n, 2] (x, y) m
    boxes: Tensor,  # [k, 5] (x, y, length, width, yaw): metres, radians
) -> Tensor:  # [n, k] m
    """From every point to every rectangle of the ground plane; 0 inside and on the border."""
    x, y = (points[:, None] - boxes[None, :, :2]).unbind(-1)
    along, across = rotate_back(boxes[:, 4].cos(), boxes[:, 4].sin(), x, y)
    return torch.hypot(
        (along.abs() - 0.5 * boxes[:, 2]).clamp(min=0.0), (across.abs() - 0.5 * boxes[:, 3]).clamp(min=0.0)
    )


def count_points_in_boxes(
    points: Tensor,  # [n, 3] m
    boxes: Tensor,  # [k, 5] as above
    heights: Tensor,  # [k, 2] m, lower and upper face
    chunk: int = 1 << 15,  # points compared at once: clouds of LiDAR are large
) -> Tensor:  # [k] int64
    """How many points each box holds, borders included."""
    counts = torch.zeros(len(boxes), dtype=torch.int64, device=boxes.device)
    for some in points.split(chunk):
        level = (some[:, 2:3] >= heights[:, 0]) & (some[:, 2:3] <= heights[:, 1])
        counts += ((footprint_distances(some[:, :2], boxes) == 0) & level).sum(dim=0)
    return counts
