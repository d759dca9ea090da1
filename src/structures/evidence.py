"""What a detector shows of its inner state, for pictures and measures: its Gaussians, where it looks, its memory."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.structures.gaussians import GaussianSet


@dataclass
class WarpedPoints:
    """Remembered places of one sample, brought to the present."""

    xy: Tensor  # [n, 2] m, augmented ego frame
    velocities: Tensor  # [n, 2] m/s over ground, same axes
    elapsed_s: Tensor  # [n]
    compensated: bool  # whether `xy` includes the motion by these velocities
    gaussians: GaussianSet | None = None  # whose valid rows of the first sample these are


@dataclass
class SplattedCells:
    """The cells that the Gaussians of a batch reach."""

    grid: BEVGrid
    indices: Tensor  # [n, 3] int64 (sample, row, col)
    occupancy: Tensor  # [n] 0..1
    occupied: Tensor  # [n] bool, the model goes on with the cell


@dataclass
class HeadCells:
    """The cells that a sparse head sees; a box begins at one of them."""

    grid: BEVGrid
    indices: Tensor  # [n, 3] int64 (sample, row, col)


@dataclass
class Evidence:
    """What a model shows of a batch beside boxes, of its memory the first sample's; None for what a model lacks."""

    gaussians: GaussianSet | None = None  # refined, history among them
    cells: SplattedCells | None = None
    head_cells: HeadCells | None = None
    warped_gaussians: WarpedPoints | None = None  # empty where nothing is remembered yet
    warped_cells: WarpedPoints | None = None  # empty where nothing is remembered yet
    warped_queries: WarpedPoints | None = None  # empty where nothing is remembered yet
