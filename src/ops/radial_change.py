"""What velocities change by when their radial part becomes the nearest measured one (method 1.4)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.geometry.constants import counting
from src.ops.backend import implementation
from src.ops.sites import rows_of_keys

BIN_MPS = 6.0
NUM_BINS = 31
"""Bins of radial speed, which keep a mover, what stands beside it and an aliased value apart."""
NEAR_BINS = 2
"""How far a prediction may be from the measured value it takes: 12 to 18 m/s, less than an aliased value is off."""
MIN_SPEED_MPS = 0.5
"""Below it a velocity is noise whose direction says nothing; the line of sight is then that from the ego's origin."""


def radial_change(
    velocities: Tensor,  # [n, 2] m/s over ground, augmented axes
    cells: Tensor,  # [n] int64 linear keys (b * rows + row) * cols + col, or [B, n / B, 2] positions in metres
    keys: Tensor,  # [m] int64 linear key * NUM_BINS + bin, sorted, unique
    measured: Tensor,  # [m, 2] m/s
    grid: BEVGrid,
    added: bool = False,
) -> Tensor:  # [n, 2] m/s
    """From each velocity to that with the measured radial part that is nearest to its own; zero where none is near.

    Near is within NEAR_BINS of the own bin of radial speed. `added` gives the new velocity itself. Without gradient.
    """
    with torch.no_grad():
        return implementation(radial_change_reference)(velocities, cells, keys, measured, grid, added)


def radial_change_reference(
    velocities: Tensor, cells: Tensor, keys: Tensor, measured: Tensor, grid: BEVGrid, added: bool = False
) -> Tensor:
    """Plain torch form."""
    if cells.dim() == 3:
        row, col = grid.cell_of(cells).unbind(-1)  # [B, n / B]
        sample = counting(len(row), torch.int64, row.device)[:, None]
        cells = ((sample * grid.rows + row) * grid.cols + col).flatten()
    row, col = torch.div(cells, grid.cols, rounding_mode="floor") % grid.rows, cells % grid.cols
    sight = F.normalize(grid.centre_of(torch.stack([row, col], dim=1)), dim=1)
    near = counting(2 * NEAR_BINS + 1, torch.int64, cells.device) - NEAR_BINS
    bins = radial_bin((velocities * sight).sum(dim=1))[:, None] + near
    rows = rows_of_keys(keys, cells[:, None] * NUM_BINS + bins.clamp(0, NUM_BINS - 1))  # [n, 5]
    found = F.embedding(rows.where(rows >= 0, len(keys)), F.pad(measured, (0, 0, 0, 1)))
    miss = ((found - velocities[:, None]) * sight[:, None]).sum(dim=2).abs()
    best = miss.where(rows >= 0, torch.inf).argmin(dim=1, keepdim=True)  # [n, 1]
    found = found.gather(1, best[..., None].expand(-1, -1, 2)).squeeze(1)
    moving = found.norm(dim=1, keepdim=True) > MIN_SPEED_MPS
    direction = F.normalize(torch.where(moving, found, sight), dim=1)
    change = ((found - velocities) * direction).sum(dim=1, keepdim=True) * direction
    change = change * (rows.gather(1, best) >= 0)
    return velocities + change if added else change


def radial_bin(
    radial_mps: Tensor,  # [...] signed, positive for what moves away
) -> Tensor:  # [...] int64 in 0..NUM_BINS - 1
    """The bin of each radial speed."""
    half = NUM_BINS // 2
    return (radial_mps / BIN_MPS).round().clamp(-half, half).long() + half
