"""What a detector shows of its inner state, for pictures: its Gaussians, where it looks, what it remembers."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

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
class Evidence:
    """Of the first sample of a batch; None for what a model does not have."""

    gaussians: GaussianSet | None = None
    occupied_cells: Tensor | None = None  # [n, 2] int64 (row, col)
    occupancy: Tensor | None = None  # [n] of these cells, 0..1
    warped_gaussians: WarpedPoints | None = None  # empty where nothing is remembered yet
    warped_cells: WarpedPoints | None = None  # empty where nothing is remembered yet
