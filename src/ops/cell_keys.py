"""Keys of the cells that points lie in, and centres of the cells of keys, for sets of sites in fixed shapes."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.geometry.constants import constant
from src.ops.backend import implementation
from src.ops.sites import Sites


@torch.no_grad()
def cell_keys(
    points: Tensor,  # [n, d] metres in the order (x, y[, z])
    samples: Tensor,  # [m] int64, the sample of n / m points each; any from the number of samples on is none
    valid: Tensor | None,  # [n] bool
    lower_m: tuple[float, ...],  # (x, y[, z]) lower corner of the grid
    size_m: tuple[float, ...],  # (x, y[, z]) of a cell
    shape: tuple[int, ...],  # (batch[, z], y, x)
    dtype: torch.dtype,  # to compute in
    behind: int = 0,
) -> Tensor:  # [n + behind] int64
    """Key of the cell that holds each point; `Sites.end` for a point outside, not finite or not valid, and behind."""
    return implementation(cell_keys_reference)(points, samples, valid, lower_m, size_m, shape, dtype, behind)


def cell_keys_reference(
    points: Tensor,
    samples: Tensor,
    valid: Tensor | None,
    lower_m: tuple[float, ...],
    size_m: tuple[float, ...],
    shape: tuple[int, ...],
    dtype: torch.dtype,
    behind: int = 0,
) -> Tensor:
    """Plain torch form."""
    lower, size = constant((tuple(lower_m), tuple(size_m)), dtype, points.device)
    cells = ((points.to(dtype) - lower) / size).floor().flip(1)  # [n, d] ([z,] y, x)
    inside = ((cells >= 0) & (cells < constant(tuple(shape[1:]), torch.int64, cells.device))).all(1)
    if valid is not None:
        inside = inside & valid
    sites = Sites(tuple(shape), samples)
    sample = samples.repeat_interleave(len(points) // max(len(samples), 1), output_size=len(points))
    keys = sites.keys_of(torch.cat([sample[:, None], cells.long()], dim=1))
    return F.pad(torch.where(inside, keys, sites.end).clamp_(max=sites.end), (0, behind), value=sites.end)


@torch.no_grad()
def cell_centres(
    keys: Tensor,  # [n] int64 of sites on (B, rows, cols)
    grid: BEVGrid,
) -> Tensor:  # [n, 2] float32 (x, y) metres
    """Centre of each cell."""
    return implementation(cell_centres_reference)(keys, grid)


def cell_centres_reference(keys: Tensor, grid: BEVGrid) -> Tensor:
    """Plain torch form."""
    return grid.centre_of(Sites((1, *grid.cells), keys).indices()[:, 1:])
