"""Which cells each Gaussian reaches: the ragged (Gaussian, cell) pairs that a splat is made from (Eq. 4)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.geometry.box_cells import window_cells, window_corners
from src.geometry.constants import arange, where_scalar
from src.geometry.ragged import enumerate_some_windows
from src.geometry.tensor_transforms import rotate_back
from src.ops.backend import implementation
from src.ops.fixed_shapes import fixed_shapes
from src.ops.segment_reduce import inverse_rows

# Windows are widened by this before the exact test, so that rounding cannot lose a cell.
WINDOW_SLACK_CELLS = 1e-3


@dataclass(eq=False)
class GaussianCellPairs:
    """(Gaussian, cell) pairs in the order of the cells, and the way back to the order of the Gaussians.

    By Gaussian, the pairs of one Gaussian stand in the order of their cells. In fixed shapes padding stands behind the
    pairs of the cells and among those of the Gaussians, at infinite distance from a cell beyond the last.
    """

    gaussian: Tensor  # [pairs] integer
    cell: Tensor  # [pairs] integer, row in the support, ascending
    delta: Tensor | None  # [pairs, 2] cell centre - mean, metres; None without gradient
    q: Tensor  # [pairs] squared Mahalanobis distance
    pair_index: Tensor  # [pairs] int64, 0, 1, 2, ...
    cell_starts: Tensor  # [n + 1] integer, first pair of each support cell
    by_gaussian: Tensor  # [pairs] integer, pairs in the order of the Gaussians
    gaussian_starts: Tensor  # [G + 1] integer, first place of each Gaussian in by_gaussian


@torch.no_grad()
def gaussian_cells(
    means: Tensor,
    scales: Tensor,
    directions: Tensor,
    batch: Tensor,
    grid: BEVGrid,
    batch_size: int,
    support_sigmas: float,
) -> tuple[GaussianCellPairs, Tensor]:
    """All pairs with q <= support_sigmas^2, and the linear keys [n] of the cells they reach."""
    inputs, num_cells = (means, scales, directions, batch), batch_size * grid.rows * grid.cols
    fixed = fixed_shapes()
    if fixed is not None:
        size = fixed.capacities.pairs
        pairs, missing = implementation(padded_pairs_reference)(*inputs, grid, num_cells, support_sigmas, size)
        fixed.expect(missing, -size)
        return pairs, arange(num_cells + 1, torch.int64, means.device)
    found = implementation(near_pairs_reference)(*inputs, grid, num_cells, support_sigmas)
    gaussian, linear, near, q, delta_x, delta_y = found
    linear, order = torch.sort(linear.to(key_type(num_cells)), stable=True)
    support, cell, sizes = torch.unique_consecutive(linear, return_inverse=True, return_counts=True)
    owners = arange(len(means) + 1, gaussian.dtype, gaussian.device)
    near = near.index_select(0, order)
    pairs = GaussianCellPairs(
        gaussian=gaussian.index_select(0, order),
        cell=cell,
        delta=torch.stack([delta_x.index_select(0, near), delta_y.index_select(0, near)], 1),
        q=q.index_select(0, near),
        pair_index=arange(len(order), torch.int64, order.device),
        cell_starts=F.pad(sizes.cumsum(0), (1, 0)),
        by_gaussian=inverse_rows(order, len(order)),
        gaussian_starts=torch.searchsorted(gaussian, owners),
    )
    return pairs, support.long()


def near_pairs_reference(
    means: Tensor,
    scales: Tensor,
    directions: Tensor,
    batch: Tensor,
    grid: BEVGrid,
    num_cells: int,  # of all samples
    support_sigmas: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Plain torch form: of each pair Gaussian, cell, and its row in what follows, in the order of the Gaussians; q and
    the offset along x and y in metres of all cells of their windows."""
    centres, reach, table = gaussian_windows(means, scales, directions, grid, support_sigmas)
    gaussian, row, col = window_cells(centres, reach, grid)
    q, delta_x, delta_y = cell_distances(table.index_select(0, gaussian), row, col, grid)
    near = (q <= support_sigmas**2).nonzero().squeeze(1)
    gaussian = gaussian.index_select(0, near)  # ascending
    linear = (batch.index_select(0, gaussian) * grid.rows + row.index_select(0, near)) * grid.cols
    return gaussian, linear + col.index_select(0, near), near, q, delta_x, delta_y


def padded_pairs_reference(
    means: Tensor,
    scales: Tensor,
    directions: Tensor,
    batch: Tensor,
    grid: BEVGrid,
    num_cells: int,  # of all samples
    support_sigmas: float,
    size: int,
) -> tuple[GaussianCellPairs, Tensor]:  # and [1] int64
    """Plain torch form: the pairs among the first `size` cells of all windows in fixed shapes, and less how many such
    cells there are. The support are all cells, and the one beyond them."""
    num = len(means)
    centres, reach, table = gaussian_windows(means, scales, directions, grid, support_sigmas)
    low, high = window_corners(centres, reach, grid)
    gaussian, row, col, total = enumerate_some_windows(low, high, size)
    owner = gaussian.clamp(max=num - 1)
    q, _, _ = cell_distances(table.index_select(0, owner), row, col, grid)
    near = (q <= support_sigmas**2) & (gaussian < num)
    linear = (batch.index_select(0, owner) * grid.rows + row) * grid.cols + col
    small = key_type(num_cells)
    linear, order = torch.sort(where_scalar(near, linear, num_cells).to(small), stable=True)
    # Padding belongs to no cell: the last one ends where it begins.
    edges = arange(num_cells + 2, small, linear.device).clamp(max=num_cells)
    pairs = GaussianCellPairs(
        gaussian=owner.index_select(0, order),
        cell=linear,
        delta=None,
        q=where_scalar(near, q, math.inf).index_select(0, order),
        pair_index=arange(size, torch.int64, order.device),
        cell_starts=torch.searchsorted(linear, edges),
        by_gaussian=inverse_rows(order, size),
        gaussian_starts=torch.searchsorted(gaussian, arange(num + 1, torch.int64, gaussian.device)),
    )
    return pairs, -total


def key_type(num_cells: int) -> torch.dtype:
    """The smallest for the key of any cell, and of the one beyond them."""
    return torch.int32 if num_cells < 2**31 - 1 else torch.int64


def gaussian_windows(
    means: Tensor, scales: Tensor, directions: Tensor, grid: BEVGrid, support_sigmas: float
) -> tuple[Tensor, Tensor, Tensor]:  # [G, 2] cells each, [G, 8]
    """Centres and half extents of the windows around all Gaussians, and what `cell_distances` reads of each."""
    squares, turned = scales.square(), directions.square()
    variances = torch.stack([(turned * squares).sum(1), (turned.flip(1) * squares).sum(1)], 1)  # Sigma_xx, Sigma_yy
    centres = grid.to_cells(means) - 0.5
    reach = support_sigmas * variances.sqrt() / grid.cell_m + WINDOW_SLACK_CELLS
    # Offsets are taken from the nearest cell centre: float32 would lose five digits on coordinates of 150 m.
    nearest = centres.round()
    rest = (means.double() - grid.centre_of(nearest.flip(1), torch.float64)).to(means.dtype)  # [G, 2] m
    return centres, reach, torch.cat([nearest, rest, directions, scales], 1)


def cell_distances(
    table: Tensor,  # [n, 8] rows of that of `gaussian_windows`
    row: Tensor,  # [n]
    col: Tensor,  # [n]
    grid: BEVGrid,
) -> tuple[Tensor, Tensor, Tensor]:  # [n] each
    """Squared distances q from cells, and their offsets along x and y in metres."""
    base_x, base_y, rest_x, rest_y, cosine, sine, size_x, size_y = table.unbind(1)
    delta_x, delta_y = (col - base_x) * grid.cell_m - rest_x, (row - base_y) * grid.cell_m - rest_y
    along, across = rotate_back(cosine, sine, delta_x, delta_y)
    return (along / size_x).square() + (across / size_y).square(), delta_x, delta_y
