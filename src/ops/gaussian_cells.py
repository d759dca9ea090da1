"""Which cells each Gaussian reaches: the ragged (Gaussian, cell) pairs that a splat is made from (Eq. 4)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.geometry.box_cells import window_cells, window_corners
from src.geometry.constants import counting, where_else
from src.geometry.ragged import enumerate_some_windows
from src.geometry.tensor_transforms import rotate_back
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

    gaussian: Tensor  # [pairs] int64
    cell: Tensor  # [pairs] int64, row in the support, ascending
    delta: Tensor | None  # [pairs, 2] cell centre - mean, metres; None without gradient
    q: Tensor  # [pairs] squared Mahalanobis distance
    in_turn: Tensor  # [pairs] int64, 0, 1, 2, ...
    cell_starts: Tensor  # [n + 1] int64, first pair of each support cell
    by_gaussian: Tensor  # [pairs] int64, pairs in the order of the Gaussians
    gaussian_starts: Tensor  # [G + 1] int64, first place of each Gaussian in by_gaussian


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
    squares, turned = scales.square(), directions.square()
    variances = torch.stack([(turned * squares).sum(1), (turned.flip(1) * squares).sum(1)], 1)  # Sigma_xx, Sigma_yy
    centres = grid.to_cells(means) - 0.5
    reach = support_sigmas * variances.sqrt() / grid.cell_m + WINDOW_SLACK_CELLS
    fixed = fixed_shapes()
    if fixed is None:
        gaussian, row, col = window_cells(centres, reach, grid)
        owner = gaussian
    else:
        low, high = window_corners(centres, reach, grid)
        gaussian, row, col, total = enumerate_some_windows(low, high, fixed.capacities.pairs)
        fixed.expect(-total, -fixed.capacities.pairs)
        owner = gaussian.clamp(max=len(means) - 1)
    # Offsets are taken from the nearest cell centre: float32 would lose five digits on coordinates of 150 m.
    nearest = centres.round()
    rest = (means.double() - grid.centre_of(nearest.flip(1), torch.float64)).to(means.dtype)  # [G, 2] m
    table = torch.cat([nearest, rest, directions, scales], 1).index_select(0, owner)
    base_x, base_y, rest_x, rest_y, cosine, sine, size_x, size_y = table.unbind(1)  # [candidates] each
    delta_x, delta_y = (col - base_x) * grid.cell_m - rest_x, (row - base_y) * grid.cell_m - rest_y
    along, across = rotate_back(cosine, sine, delta_x, delta_y)
    q = (along / size_x).square() + (across / size_y).square()
    if fixed is not None:
        near = (q <= support_sigmas**2) & (gaussian < len(means))
        linear = (batch.index_select(0, owner) * grid.rows + row) * grid.cols + col
        return _padded_pairs(gaussian, owner, linear, q, near, batch_size * grid.rows * grid.cols, len(means))
    near = (q <= support_sigmas**2).nonzero().squeeze(1)

    gaussian = gaussian.index_select(0, near)  # ascending
    linear = (batch.index_select(0, gaussian) * grid.rows + row.index_select(0, near)) * grid.cols
    linear = linear + col.index_select(0, near)
    num_cells = batch_size * grid.rows * grid.cols
    linear, order = torch.sort(linear.to(torch.int32 if num_cells < 2**31 else torch.int64), stable=True)
    support, cell, sizes = torch.unique_consecutive(linear, return_inverse=True, return_counts=True)
    owners = counting(len(means) + 1, torch.int64, gaussian.device)
    near = near.index_select(0, order)
    pairs = GaussianCellPairs(
        gaussian=gaussian.index_select(0, order),
        cell=cell,
        delta=torch.stack([delta_x.index_select(0, near), delta_y.index_select(0, near)], 1),
        q=q.index_select(0, near),
        in_turn=counting(len(order), torch.int64, order.device),
        cell_starts=F.pad(sizes.cumsum(0), (1, 0)),
        by_gaussian=inverse_rows(order, len(order)),
        gaussian_starts=torch.searchsorted(gaussian, owners),
    )
    return pairs, support.long()


def _padded_pairs(
    gaussian: Tensor,  # [pairs] int64, ascending, `num` for none
    owner: Tensor,  # [pairs] int64, the same with a Gaussian that exists
    linear: Tensor,  # [pairs] int64, cells
    q: Tensor,  # [pairs]
    near: Tensor,  # [pairs] bool, what is a pair
    num_cells: int,
    num: int,
) -> tuple[GaussianCellPairs, Tensor]:
    """The pairs in fixed shapes; the support are all cells, and the one beyond them."""
    small = torch.int32 if num_cells < 2**31 - 1 else torch.int64
    linear, order = torch.sort(where_else(near, linear, num_cells).to(small), stable=True)
    # Padding belongs to no cell: the last one ends where it begins.
    edges = counting(num_cells + 2, small, linear.device).clamp(max=num_cells)
    support, starts = counting(num_cells + 1, torch.int64, linear.device), torch.searchsorted(linear, edges)
    pairs = GaussianCellPairs(
        gaussian=owner.index_select(0, order),
        cell=linear.long(),
        delta=None,
        q=where_else(near, q, math.inf).index_select(0, order),
        in_turn=counting(len(order), torch.int64, order.device),
        cell_starts=starts,
        by_gaussian=inverse_rows(order, len(order)),
        gaussian_starts=torch.searchsorted(gaussian, counting(num + 1, torch.int64, gaussian.device)),
    )
    return pairs, support
