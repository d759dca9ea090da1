"""Gaussians to bird's-eye-view cells: occupancy, occupied cells and their features (Eq. 4-6)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import FunctionCtx

from src.geometry.bev_grid import BEVGrid
from src.geometry.constants import where_scalar
from src.geometry.tensor_transforms import rotate_back
from src.ops.backend import implementation
from src.ops.fixed_shapes import fixed_shapes
from src.ops.gaussian_cells import GaussianCellPairs, gaussian_cells
from src.ops.segment_reduce import gather_segment_sum, inverse_rows, rank_per_sample, weighted_segment_sum
from src.ops.sites import Sites

# A contribution is at most 1 - CAP, so that the logarithm of the free probability stays finite; its -log is at least:
CAP = 1e-4
LEAST_SURPRISE = -math.log1p(-CAP)

Choice = tuple[Tensor, float, int, int]
"""What the choice of occupied cells needs: the support, threshold, max_cells and the number of cells of a sample."""


@dataclass(frozen=True, eq=False)
class Splat:
    """What a set of Gaussians does to the cells of a batch of grids.

    The support are the cells that at least one Gaussian reaches; everywhere else alpha = 0 and S = 0.
    Linear keys are (batch * rows + row) * cols + col.
    """

    support: Tensor  # [n] int64 linear keys, sorted
    log_free: Tensor  # [n] S = log(1 - alpha) <= 0
    occupied: Sites  # Omega, the cells with alpha above the threshold, shape (B, rows, cols)
    features: Tensor  # [w, C] F_G at the occupied cells
    occupied_rows: Tensor  # [w] int64, row of each occupied cell in the support
    peak_cell: Tensor  # [G] int64, linear key of the occupied cell where it contributes most, -1 if it reaches none
    peak_contribution: Tensor  # [G] a_i there, 0 if it reaches none
    num_cut: int  # occupied cells dropped by the max_cells guard; in fixed shapes more of them overflow

    @property
    def occupancy(self) -> Tensor:  # [n]
        """alpha = 1 - exp(S) on the support."""
        return -torch.expm1(self.log_free)


def log1mexp(
    u: Tensor,  # [...] > 0
) -> Tensor:  # [...]
    """log(1 - exp(-u)) without cancellation on either side."""
    small = u < math.log(2.0)
    # Each branch sees harmless arguments where the other is taken, or its gradient would be NaN.
    near = torch.log(-torch.expm1(-torch.where(small, u, 1.0)))
    far = torch.log1p(-torch.exp(-torch.where(small, 1.0, u)))
    return torch.where(small, near, far)


def splat_gaussians(
    means: Tensor,  # [G, 2] (x, y) metres
    scales: Tensor,  # [G, 2] standard deviations along and across, metres
    directions: Tensor,  # [G, 2] (cos, sin), unit
    opacity_logits: Tensor,  # [G]
    features: Tensor,  # [G, C]
    batch: Tensor,  # [G] int64, sample of each Gaussian, any order
    grid: BEVGrid,
    batch_size: int,
    threshold: float,
    max_cells: int,
    support_sigmas: float,
) -> Splat:
    """Splat Gaussians onto BEV cells (Eq. 4-6, method 5.6).

    k_i(p) = exp(-q/2) within `support_sigmas`, else 0; a_i = sigmoid(o_i) k_i, at most 1 - 1e-4; S = sum log(1 - a_i);
    alpha = 1 - exp(S); Omega = {alpha > threshold}; F_G(p) = sum k_i(p) f_i on Omega. At most `max_cells` cells a
    sample stay in Omega, the most occupied ones. The cap stops the gradient of a contribution it binds for.

    Gradients of `log_free` and `features` reach all five float inputs; Omega is a constant set. Computed in float32
    (float64 for float64 inputs) whatever autocast says, the same on every run. Gaussians of different samples never
    meet. Raises ValueError for shapes that do not fit together.
    """
    num = len(means)
    expected = {"means": (num, 2), "scales": (num, 2), "directions": (num, 2), "opacity_logits": (num,)}
    found = {"means": means, "scales": scales, "directions": directions, "opacity_logits": opacity_logits}
    for name, tensor in found.items():
        if tensor.shape != expected[name]:
            raise ValueError(f"{name}: expected {list(expected[name])}, got {list(tensor.shape)}")
    if features.dim() != 2 or len(features) != num or batch.shape != (num,):
        raise ValueError(
            f"expected features [{num}, C] and batch [{num}], got {list(features.shape)} and {list(batch.shape)}"
        )
    dtype = torch.float64 if means.dtype == torch.float64 else torch.float32
    with torch.autocast(means.device.type, enabled=False):
        gaussians = [x.to(dtype) for x in (means, scales, directions, opacity_logits, features)]
        pairs, support = gaussian_cells(*gaussians[:3], batch, grid, batch_size, support_sigmas)
        choice = (support, threshold, max_cells, grid.rows * grid.cols)
        log_free, out, occupied_rows, peak_cell, peak_contribution, num_cut = implementation(splat_reference)(
            *gaussians, pairs, choice
        )
    # In fixed shapes the rows of the support are its keys.
    keys = support.index_select(0, occupied_rows) if fixed_shapes() is None else occupied_rows
    return Splat(
        support=support,
        log_free=log_free,
        occupied=Sites.from_linear(keys, (batch_size, grid.rows, grid.cols)),
        features=out,
        occupied_rows=occupied_rows,
        peak_cell=peak_cell,
        peak_contribution=peak_contribution,
        num_cut=num_cut,
    )


class _LogFree(torch.autograd.Function):
    """S per support cell (Eq. 5), with the closed-form gradients of method 5.6."""

    @staticmethod
    def forward(ctx: FunctionCtx, q: Tensor, opacity_logits: Tensor, pairs: GaussianCellPairs) -> Tensor:
        surprise = F.softplus(-opacity_logits).index_select(0, pairs.gaussian) + 0.5 * q  # -log a
        surprise = surprise.clamp(min=LEAST_SURPRISE)
        ctx.save_for_backward(surprise, opacity_logits)
        ctx.pairs = pairs
        return gather_segment_sum(log1mexp(surprise)[:, None], pairs.pair_index, pairs.cell_starts).squeeze(1)

    @staticmethod
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor, Tensor, None]:
        surprise, opacity_logits = ctx.saved_tensors
        pairs: GaussianCellPairs = ctx.pairs
        slope = grad.index_select(0, pairs.cell) / torch.expm1(surprise)  # d log(1 - a) / d(-log a) = a / (1 - a)
        slope = where_scalar(surprise > LEAST_SURPRISE, slope, 0.0)
        grad_logits = _gaussian_sum(slope[:, None], pairs).squeeze(1) * -torch.sigmoid(-opacity_logits)
        return 0.5 * slope, grad_logits, None


class _Distance(torch.autograd.Function):
    """The squared distances q of all pairs as a function of the Gaussians that made them."""

    @staticmethod
    def forward(
        ctx: FunctionCtx,
        means: Tensor,
        scales: Tensor,
        directions: Tensor,
        pairs: GaussianCellPairs,
    ) -> Tensor:
        ctx.save_for_backward(scales, directions)
        ctx.pairs = pairs
        return pairs.q.clone()

    @staticmethod
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor, Tensor, Tensor, None]:
        scales, directions = ctx.saved_tensors
        pairs: GaussianCellPairs = ctx.pairs
        cosine, sine, size_x, size_y = torch.cat([directions, scales], 1).index_select(0, pairs.gaussian).unbind(1)
        delta_x, delta_y = pairs.delta.unbind(1)
        along, across = rotate_back(cosine, sine, delta_x, delta_y)
        push_x, push_y = 2 * grad * along / size_x.square(), 2 * grad * across / size_y.square()  # dL/du, u = R^T d
        sums = _gaussian_sum(
            torch.stack(
                [
                    push_x,
                    push_y,
                    push_x * along,
                    push_y * across,
                    push_x * delta_x + push_y * delta_y,
                    push_x * delta_y - push_y * delta_x,
                ],
                1,
            ),
            pairs,
        )  # [G, 6]
        turn = torch.stack([directions[:, 0], -directions[:, 1], directions[:, 1], directions[:, 0]], 1)
        grad_means = -(turn.view(-1, 2, 2) @ sums[:, :2, None]).squeeze(2)  # -R dL/du
        return grad_means, -sums[:, 2:4] / scales, sums[:, 4:6], None


def splat_reference(
    means: Tensor,
    scales: Tensor,
    directions: Tensor,
    opacity_logits: Tensor,
    features: Tensor,
    pairs: GaussianCellPairs,
    choice: Choice,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, int]:
    """Plain torch form: `log_free`, `features`, `occupied_rows`, `peak_cell`, `peak_contribution` and `num_cut`."""
    support, threshold, *limits = choice
    q = _Distance.apply(means, scales, directions, pairs)
    log_free = _LogFree.apply(q, opacity_logits, pairs)
    occupied = -torch.expm1(log_free.detach()) > threshold
    occupied_rows, num_cut = occupied_cells(occupied, log_free.detach(), support, *limits)

    # Pairs of the occupied cells, and their order by Gaussian.
    cell = occupied_places(occupied_rows, support).index_select(0, pairs.cell)
    kept = cell >= 0
    chosen = kept.nonzero().squeeze(1)
    gaussian, cell = pairs.gaussian.index_select(0, chosen), cell.index_select(0, chosen)
    rank = (kept.cumsum(0) - 1).index_select(0, pairs.by_gaussian)
    by_gaussian = rank[kept.index_select(0, pairs.by_gaussian)]
    distance = q.index_select(0, chosen)
    out = weighted_segment_sum(features, torch.exp(-0.5 * distance), gaussian, cell, len(occupied_rows), by_gaussian)
    keys = support.index_select(0, occupied_rows).index_select(0, cell)
    peak_cell, peak_q = _nearest_cell(distance.detach(), gaussian, keys, len(means))
    peak_contribution = opacity_logits.detach().sigmoid() * torch.exp(-0.5 * peak_q)
    return log_free, out, occupied_rows, peak_cell, peak_contribution, num_cut


def occupied_cells(
    occupied: Tensor,  # [n] bool, above the threshold
    log_free: Tensor,  # [n]
    support: Tensor,  # [n]
    max_cells: int,
    cells_per_sample: int,
) -> tuple[Tensor, int]:
    """Occupied rows of the support, at most `max_cells` a sample, and how many were dropped for that."""
    if fixed_shapes() is not None:
        return _padded_occupied(occupied, max_cells), 0
    rows = occupied.nonzero().squeeze(1)
    if len(rows) <= max_cells:
        return rows, 0
    sample = torch.div(support.index_select(0, rows), cells_per_sample, rounding_mode="floor")
    order, rank = rank_per_sample(-log_free.index_select(0, rows), sample)
    kept = rows[order[rank < max_cells]].sort().values
    return kept, len(rows) - len(kept)


def _padded_occupied(
    occupied: Tensor,  # [n] bool, of which the last is no cell
    max_cells: int,
) -> Tensor:  # [at most max_cells + 1]
    """Rows of the occupied cells in fixed shapes; padding takes the last."""
    fixed, last = fixed_shapes(), len(occupied) - 1
    rows = fixed.places(occupied[:-1], min(max_cells, fixed.capacities.cells, last) + 1)
    fixed.expect(rows[-1:], last)
    return rows


def occupied_places(
    occupied_rows: Tensor,  # [w]
    support: Tensor,  # [n]
) -> Tensor:  # [n] int64
    """Which occupied cell each cell of the support is, -1 for none."""
    places = inverse_rows(occupied_rows, len(support))
    if fixed_shapes() is not None:
        places[-1:] = -1
    return places


def _nearest_cell(
    q: Tensor,  # [pairs]
    gaussian: Tensor,  # [pairs]
    key: Tensor,  # [pairs]
    num: int,
) -> tuple[Tensor, Tensor]:  # [num] int64, [num]
    """Key of the cell with the smallest q per Gaussian (the largest contribution), lowest on ties, -1 if none; q."""
    least = q.new_full((num,), math.inf).scatter_reduce_(0, gaussian, q, "amin")
    none = torch.iinfo(torch.int64).max
    candidates = where_scalar(q == least.index_select(0, gaussian), key, none)
    peak = key.new_full((num,), none).scatter_reduce_(0, gaussian, candidates, "amin")
    return torch.where(peak == none, -1, peak), least


def _gaussian_sum(values: Tensor, pairs: GaussianCellPairs) -> Tensor:
    """Sums of pair values [pairs, C] per Gaussian [G, C]."""
    return gather_segment_sum(values, pairs.by_gaussian, pairs.gaussian_starts)
