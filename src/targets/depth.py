"""Linear-increasing depth bins and the painted depth target of the camera branch (method 4.2, 4.3)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import torch
from torch import Tensor

from src.errors import ConfigError, require_least
from src.geometry.constants import constant
from src.geometry.ragged import enumerate_windows
from src.targets.projection import BoxViews


class DepthTarget(Enum):
    """What supervises depth."""

    box = "box"  # the centre depth of annotated boxes


@dataclass(kw_only=True)
class DepthBinsConfig:
    """Base of settings with depth bins."""

    num_depth_bins: int  # D, linearly increasing widths
    depth_range_m: list[float]  # [nearest, farthest] along the optical axis

    @property
    def depth_range(self) -> tuple[float, float]:
        """(nearest, farthest) in metres."""
        return self.depth_range_m[0], self.depth_range_m[1]

    def check_depth_bins(self, key: str) -> None:
        """Raises ConfigError, naming `key`, for values that cannot work."""
        require_least(self, key, {"num_depth_bins": 1})
        low_high = self.depth_range_m
        if len(low_high) != 2 or not 0 < low_high[0] < low_high[1]:
            raise ConfigError(f"{key}.depth_range_m={low_high}: must be [near, far] in metres with 0 < near < far")


def lid_edges(
    depth_range_m: tuple[float, float],
    num_bins: int,
    dtype: torch.dtype = torch.float32,
) -> Tensor:  # [num_bins + 1] m
    """Bin edges e_i = low + delta i (i + 1) / 2 with delta = 2 (high - low) / (n (n + 1)) (method 4.2)."""
    low, high = depth_range_m
    number = torch.arange(num_bins + 1, dtype=torch.float64)
    edges = low + (high - low) * number * (number + 1) / (num_bins * (num_bins + 1))
    return edges.to(dtype)


def lid_centres(
    depth_range_m: tuple[float, float],
    num_bins: int,
    dtype: torch.dtype = torch.float32,
) -> Tensor:  # [num_bins] m
    """Mean of the two edges of each bin: the depth a bin stands for."""
    edges = lid_edges(depth_range_m, num_bins, torch.float64)
    return (0.5 * (edges[:-1] + edges[1:])).to(dtype)


def lid_index(
    depths_m: Tensor,  # [...]
    depth_range_m: tuple[float, float],
    num_bins: int,
) -> Tensor:  # [...] int64
    """Bin of each depth, lower edge included; -1 outside [low, high), for NaN and for infinity."""
    edges = tuple(lid_edges(depth_range_m, num_bins, depths_m.dtype).tolist())
    edges = constant(edges, depths_m.dtype, depths_m.device)
    bins = torch.searchsorted(edges, depths_m.contiguous(), right=True) - 1
    return bins.where((depths_m >= edges[0]) & (depths_m < edges[-1]), -1)


def paint_depth(
    seen: BoxViews,
    num_views: int,  # B * N
    image_size_px: tuple[int, int],  # (H, W)
    depth_range_m: tuple[float, float],
    num_bins: int,
    stride_px: int,
) -> Tensor:  # [B * N, H / stride, W / stride] int64
    """Depth bin of the nearest box whose clipped 2D hull covers each cell, -1 for background (method 4.3).

    Boxes out of the depth range are painted, too, and leave background: what stands before an object hides it.
    """
    rows, cols = image_size_px[0] // stride_px, image_size_px[1] // stride_px
    limit = constant((cols, rows), seen.hulls_px.dtype, seen.hulls_px.device)
    low = (seen.hulls_px[:, :2] / stride_px).floor().long()
    high = torch.minimum((seen.hulls_px[:, 2:] / stride_px).ceil(), limit).long()
    owners, row, col = enumerate_windows(low, high - 1)
    depths = seen.depths_m.new_full((num_views * rows * cols,), torch.inf)
    depths.scatter_reduce_(0, (seen.views[owners] * rows + row) * cols + col, seen.depths_m[owners], "amin")
    return lid_index(depths, depth_range_m, num_bins).view(num_views, rows, cols)
