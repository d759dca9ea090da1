"""Radial velocities that points measure around cells, and what they make of given ones (method 1.4)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.geometry.constants import arange, constant, where_scalar
from src.ops.backend import implementation
from src.ops.moved_keys import NONE
from src.ops.sites import rows_of_keys

BIN_MPS = 6.0
NUM_BINS = 31
"""Bins of radial speed, which keep a mover, what stands beside it and an aliased value apart."""
NEAR_BINS = 2
"""How far a prediction may be from the measured value it takes: 12 to 18 m/s, less than an aliased value is off."""
WINDOW_CELLS = 2
"""A cell knows the points of its 5x5 neighbourhood; their weight falls off linearly along both axes."""
REACH = tuple(range(-WINDOW_CELLS, WINDOW_CELLS + 1))
FALLOFF = tuple(WINDOW_CELLS + 1 - abs(offset) for offset in REACH)
MIN_SPEED_MPS = 0.5
"""Below it a velocity is noise whose direction says nothing; the line of sight is then that from the ego's origin."""


@torch.no_grad()
def radial_votes(
    points: Tensor,  # [P, 7] x, y, z (m, aug frame), rcs (dB), vx, vy (m/s), dt (s)
    batch: Tensor,  # [P] int64
    grid: BEVGrid,
) -> tuple[Tensor, Tensor]:  # [25 P] int64, [25 P, 3]
    """What each point says of the cells around it: linear key * NUM_BINS + bin, and (1, vx, vy) times its weight.

    The key is NONE outside the grid, and everywhere for a point outside. Without gradient.
    """
    return implementation(radial_votes_reference)(points, batch, grid)


def radial_votes_reference(points: Tensor, batch: Tensor, grid: BEVGrid) -> tuple[Tensor, Tensor]:
    """Plain torch form."""
    xy, velocities = points[:, :2].float(), points[:, 4:6].float()
    approach = (velocities * xy).sum(dim=1).sign()
    bins = radial_bin(approach * velocities.norm(dim=1))
    reach = constant(REACH, torch.int64, xy.device)
    falloff = constant(tuple(float(a * b) for a in FALLOFF for b in FALLOFF), xy.dtype, xy.device)  # [25]
    row, col = (places[:, None] + reach for places in grid.cell_of(xy).unbind(1))  # [P, 5] each
    in_row, in_col = row == row.clamp(0, grid.rows - 1), col == col.clamp(0, grid.cols - 1)
    within = in_row[:, :, None] & in_col[:, None] & grid.contains(xy)[:, None, None]  # [P, 5, 5]
    linear = ((batch[:, None] * grid.rows + row) * grid.cols)[:, :, None] + col[:, None]
    keys = where_scalar(within, linear * NUM_BINS + bins[:, None, None], NONE).flatten()
    values = F.pad(velocities, (1, 0), value=1.0)  # [P, 3]
    return keys, (values[:, None] * falloff[:, None]).flatten(0, 1)


def radial_correction(
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
        return implementation(radial_correction_reference)(velocities, cells, keys, measured, grid, added)


def radial_correction_reference(
    velocities: Tensor, cells: Tensor, keys: Tensor, measured: Tensor, grid: BEVGrid, added: bool = False
) -> Tensor:
    """Plain torch form."""
    if cells.dim() == 3:
        row, col = grid.cell_of(cells).unbind(-1)  # [B, n / B]
        sample = arange(len(row), torch.int64, row.device)[:, None]
        cells = ((sample * grid.rows + row) * grid.cols + col).flatten()
    row, col = torch.div(cells, grid.cols, rounding_mode="floor") % grid.rows, cells % grid.cols
    sight = F.normalize(grid.centre_of(torch.stack([row, col], dim=1)), dim=1)
    near = arange(2 * NEAR_BINS + 1, torch.int64, cells.device) - NEAR_BINS
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
