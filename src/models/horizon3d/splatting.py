"""From a set of Gaussians to the sparse BEV map they occupy (Eq. 4-6)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.geometry.constants import arange, where_scalar
from src.ops.fixed_shapes import fixed_shapes
from src.ops.splat import Splat, splat_gaussians
from src.structures.gaussians import GaussianSet
from src.structures.sparse_bev import SparseBEV

FAR_M = 1e6
"""Beyond any grid."""


@dataclass
class GaussianSplat:
    """The splat of a GaussianSet; per-Gaussian results are back in [B, G], padding as what reaches no occupied cell."""

    cells: Splat  # occupancy on every cell that a Gaussian reaches
    bev: SparseBEV  # F_G on the occupied cells
    peak_cells: Tensor  # [B, G] int64 linear key of the occupied cell where the Gaussian contributes most, -1 for none
    peak_contributions: Tensor  # [B, G] a_i there, 0 for none

    def active(self, min_contribution: float = 0.0) -> Tensor:  # [B, G] bool
        """The Gaussian contributes that much to an occupied cell; 0: its support reaches one."""
        return self.peak_contributions >= min_contribution if min_contribution > 0 else self.peak_cells >= 0


def splat_set(
    gaussians: GaussianSet,
    grid: BEVGrid,
    occupancy_threshold: float,
    max_occupied_cells: int,
    support_sigmas: float,
    picks: Tensor | None = None,  # [V] int64, `valid_rows` of the Gaussians, where the caller has them
) -> GaussianSplat:
    """Splat the valid Gaussians of every sample."""
    b, g = gaussians.valid.shape
    if fixed_shapes() is None:
        picks = gaussians.valid_rows() if picks is None else picks
        batch = torch.div(picks, g, rounding_mode="floor")
    else:
        picks = None  # all of them: padding reaches no cell from where it is
        gaussians = replace(gaussians, means=where_scalar(gaussians.valid[..., None], gaussians.means, FAR_M))
        batch = arange(b, torch.int64, gaussians.means.device)[:, None].expand(b, g).flatten()
    names = ("means", "scales", "directions", "opacity_logits", "features")
    flat = {name: getattr(gaussians, name).flatten(0, 1) for name in names}
    if picks is not None:
        flat = {name: value.index_select(0, picks) for name, value in flat.items()}
    cells = splat_gaussians(
        **flat,
        batch=batch,
        grid=grid,
        batch_size=b,
        threshold=occupancy_threshold,
        max_cells=max_occupied_cells,
        support_sigmas=support_sigmas,
    )
    peaks, contributions = cells.peak_cell, cells.peak_contribution
    if picks is not None:
        peaks = picks.new_full((b * g,), -1).index_copy(0, picks, peaks)
        contributions = contributions.new_zeros(b * g).index_copy(0, picks, contributions)
    bev = SparseBEV(cells.occupied, cells.features)
    return GaussianSplat(cells, bev, peaks.view(b, g), contributions.view(b, g))
