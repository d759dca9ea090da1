"""Target of the 2D keypoint head: a Gaussian at every visible projected box centre (method 4.3)."""

from __future__ import annotations

import torch
from torch import Tensor

from src.geometry.ragged import enumerate_windows
from src.targets.projection import BoxViews

MAX_RADIUS_CELLS = 16


def keypoint_heatmap(
    seen: BoxViews,
    num_views: int,  # B * N
    image_size_px: tuple[int, int],  # (H, W)
    depth_range_m: tuple[float, float],
    stride_px: int,
) -> Tensor:  # [B * N, H / stride, W / stride] in 0..1
    """Draw a Gaussian for each box whose 3D centre lies inside the image at a depth in [low, high).

    The cell that holds the centre gets exactly 1. Radius in cells: the distance from the centre to the nearest side
    of the clipped hull, rounded up, in 1..16; sigma = (2 r + 1) / 6; drawn over (2 r + 1)^2 cells, the maximum wins.
    """
    rows, cols = image_size_px[0] // stride_px, image_size_px[1] // stride_px
    cells = (seen.centers_px / stride_px).floor()  # [V, 2] (col, row)
    inside = (cells >= 0).all(1) & (cells[:, 0] < cols) & (cells[:, 1] < rows)
    drawn = inside & (seen.depths_m >= depth_range_m[0]) & (seen.depths_m < depth_range_m[1])
    col, row = torch.where(drawn[:, None], cells, -1).long().unbind(1)
    view, center, hull = seen.views, seen.centers_px, seen.hulls_px

    margin = torch.cat([center - hull[:, :2], hull[:, 2:] - center], dim=1).amin(1)
    radius = (margin / stride_px).ceil().clamp(1, MAX_RADIUS_CELLS).long()
    cell = torch.stack([col, row], 1)
    reach = torch.where(drawn, radius, -1)[:, None]  # nothing where it is not drawn
    owners, down, right = enumerate_windows(cell - reach, cell + reach)
    squared = (down - row[owners]) ** 2 + (right - col[owners]) ** 2
    values = torch.exp(-squared / (2 * ((2 * radius + 1)[owners] / 6) ** 2))

    within = (down >= 0) & (down < rows) & (right >= 0) & (right < cols)
    flat = torch.where(within, (view[owners] * rows + down) * cols + right, num_views * rows * cols)
    heatmap = center.new_zeros(num_views * rows * cols + 1)  # one more place, for what lies outside
    heatmap.scatter_reduce_(0, flat, values.to(heatmap.dtype), "amax")
    return heatmap[:-1].view(num_views, rows, cols)
