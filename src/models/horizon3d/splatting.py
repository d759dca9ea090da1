"""From a set of Gaussians to the sparse BEV map they occupy (Eq. 4-6)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.ops.splat import Splat, splat_gaussians
from src.structures.gaussians import GaussianSet
from src.structures.sparse_bev import SparseBEV


@dataclass
class GaussianSplat:
    """The splat of a GaussianSet; per-Gaussian results are back in [B, G], padding inactive."""

    cells: Splat  # occupancy on every cell that a Gaussian reaches
    bev: SparseBEV  # F_G on the occupied cells
    active: Tensor  # [B, G] bool, the Gaussian reaches an occupied cell
    peak_cells: Tensor  # [B, G] int64 linear cell key where the Gaussian contributes most, -1 if not active


def splat_set(
    gaussians: GaussianSet,
    grid: BEVGrid,
    occupancy_threshold: float,
    max_occupied_cells: int,
    support_sigmas: float,
) -> GaussianSplat:
    """Splat the valid Gaussians of every sample."""
    b, g = gaussians.valid.shape
    picks = gaussians.valid.flatten().nonzero().squeeze(1)  # [V]
    flat = {
        name: getattr(gaussians, name).flatten(0, 1).index_select(0, picks)
        for name in ("means", "scales", "directions", "opacity_logits", "features")
    }
    cells = splat_gaussians(
        **flat,
        batch=torch.div(picks, g, rounding_mode="floor"),
        grid=grid,
        batch_size=b,
        threshold=occupancy_threshold,
        max_cells=max_occupied_cells,
        support_sigmas=support_sigmas,
    )
    active = torch.zeros(b * g, dtype=torch.bool, device=picks.device).index_copy(0, picks, cells.active)
    peak_cells = picks.new_full((b * g,), -1).index_copy(0, picks, cells.peak_cell)
    return GaussianSplat(cells, SparseBEV(cells.occupied, cells.features), active.view(b, g), peak_cells.view(b, g))
