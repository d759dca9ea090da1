"""Features at points: those of the voxel around a point and of its face neighbours, looked up by index (lrs 5.6)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from src.geometry.constants import constant
from src.geometry.voxel_grid import VoxelGrid
from src.ops.segment_reduce import segment_sum, weighted_segment_sum
from src.ops.site_index import SiteIndex, Windows
from src.ops.sites import Sites

OFFSETS = ((0, 0, 0), (-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1))
"""Offsets (z, y, x) of a voxel itself and of its six face neighbours."""
SOFTENING = 0.1
"""Share of a voxel's edge along x that is added to distances, so that a voxel's weight is finite at its centre."""


def ball_query(
    features: Tensor,  # [M, C]
    sites: Sites,  # M voxels of (batch, z, y, x)
    grid: VoxelGrid,  # of the sites
    points: Tensor,  # [q, 3] x, y, z m
    batch: Tensor,  # [q] int64, sample of each point
    neighbours: int,  # 1 or 7
) -> Tensor:  # [q, C]
    """Mean of the voxel that holds each point and, with 7, of its six face neighbours, weighted by inverse distance.

    f(p) = sum w_k f_k / sum w_k over the voxels that exist, w_k = 1 / (0.1 v + |p - c_k|) with centres c_k and the edge
    v (O12); zeros where none exists or the point lies outside the grid. Differentiable in the features and, through the
    weights, in the points. Raises ValueError for another number of neighbours or sites of another grid.
    """
    if neighbours not in (1, len(OFFSETS)):
        raise ValueError(f"neighbours={neighbours}: must be 1 or {len(OFFSETS)}, the voxel alone or with its faces'")
    if sites.shape[1:] != grid.cells:
        raise ValueError(f"the sites lie on {sites.shape[1:]} voxels, but the grid has {grid.cells}")
    if neighbours == 1:
        points = points.detach()  # the weight is 1 wherever in the voxel it lies
    cells, inside = grid.cell_of(points.detach()), grid.contains(points.detach())
    cells = torch.where(inside[:, None], cells, 0)
    keys = sites.keys_of(torch.cat([batch[:, None], cells], dim=1))
    windows, taps = _windows(sites, keys, neighbours)
    point, place = (windows.found().index_select(0, taps) & inside).t().nonzero().unbind(1)  # pairs, point by point
    picks = windows.sites(taps.index_select(0, place), point)
    centres = grid.centre_of(sites.indices()[:, 1:]).to(points.dtype)
    distance = (F.embedding(point, points) - F.embedding(picks, centres)).norm(dim=1)
    weights = 1 / (SOFTENING * grid.voxel_m[0] + distance)
    total = segment_sum(weights[:, None], point, len(points))
    weights = weights / F.embedding(point, total).squeeze(1)
    return weighted_segment_sum(features.to(weights.dtype), weights, picks, point, len(points))


def _windows(
    sites: Sites,
    keys: Tensor,  # [q] int64, of voxels of the grid: their faces lie in the halo at most
    neighbours: int,
) -> tuple[Windows, Tensor]:  # and [neighbours] int64
    """Runs of cells that hold each voxel and its neighbours, and which row of `Windows.found` is which of OFFSETS."""
    reach = int(neighbours > 1)  # along x
    width, offsets = 1 + 2 * reach, OFFSETS[:neighbours]
    lines = list(dict.fromkeys((z, y) for z, y, _ in offsets))
    taps = tuple(lines.index((z, y)) * width + x + reach for z, y, x in offsets)
    rows = tuple(z * (sites.strides[1] // sites.strides[2]) + y for z, y in lines)
    windows = SiteIndex.of(sites).windows(keys - reach, constant(rows, torch.int64, keys.device), width)
    return windows, constant(taps, torch.int64, keys.device)
