"""Voxels of a region of interest at several scales, each twice as coarse as the one before (lrs 2.2)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from src.errors import ConfigError
from src.geometry.bev_grid import BEVGrid
from src.geometry.constants import constant

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class VoxelGrid:
    """Voxels over a box of the (augmented) ego frame, which need not be centred on the ego; cells are (z, row, col).

    `lower_m`, `upper_m` and `voxel_m` are (x, y, z). The grid has `num_levels` levels, of which it is the finest itself
    and `at(l)` is 2^l times as coarse.

    Raises ConfigError for a region that is empty or not whole voxels, 2^(num_levels - 1) of them or a multiple, wide.
    """

    lower_m: Triple
    upper_m: Triple
    voxel_m: Triple
    num_levels: int

    def __post_init__(self) -> None:
        for name in ("lower_m", "upper_m", "voxel_m"):
            value = getattr(self, name)
            if len(value) != 3 or not all(math.isfinite(number) for number in value):
                raise ConfigError(f"model.roi.{name}={list(value)}: must be three numbers [x, y, z] in metres")
        if min(self.voxel_m) <= 0:
            raise ConfigError(f"model.roi.voxel_m={list(self.voxel_m)}: must be positive")
        step = 2 ** (self.num_levels - 1)
        for axis, low, high, size in zip("xyz", self.lower_m, self.upper_m, self.voxel_m, strict=True):
            voxels = (high - low) / size
            if not (round(voxels) >= step and math.isclose(voxels, round(voxels), rel_tol=1e-6)):
                raise ConfigError(
                    f"model.roi: {axis} from {low:g} to {high:g} m must be a whole number of voxels of {size:g} m, at "
                    f"least {step}, but is {voxels:g}"
                )
            if round(voxels) % step:
                raise ConfigError(
                    f"model.roi: {axis} from {low:g} to {high:g} m is {round(voxels)} voxels of {size:g} m; must be a "
                    f"multiple of {step}, the coarsest of {self.num_levels} levels"
                )

    @property
    def cells(self) -> tuple[int, int, int]:
        """Number of voxels along (z, y, x)."""
        extents = zip(self.lower_m, self.upper_m, self.voxel_m, strict=True)
        x, y, z = (round((high - low) / size) for low, high, size in extents)
        return z, y, x

    def at(self, level: int) -> VoxelGrid:
        """The same region in voxels 2^level times as long. Raises ValueError for a level that the grid lacks."""
        if not 0 <= level < self.num_levels:
            raise ValueError(f"level={level}: the grid has the levels 0..{self.num_levels - 1}")
        x, y, z = (size * 2**level for size in self.voxel_m)
        return VoxelGrid(self.lower_m, self.upper_m, (x, y, z), self.num_levels - level)

    def bev(self) -> BEVGrid:
        """Its columns as cells of the ground plane. Raises ConfigError for voxels that are not square in it."""
        (x_min, y_min, z_min), (x_max, y_max, z_max) = self.lower_m, self.upper_m
        if self.voxel_m[0] != self.voxel_m[1]:
            raise ConfigError(
                f"model.roi.voxel_m={list(self.voxel_m)}: x and y must be equal, for cells of the ground plane"
            )
        centre = ((x_min + x_max) / 2, (y_min + y_max) / 2)
        return BEVGrid(self.cells[1:], self.voxel_m[0], centre, (z_min, z_max))

    def cell_of(
        self,
        xyz: Tensor,  # [..., 3] m
    ) -> Tensor:  # [..., 3] int64 (z, row, col), possibly outside the grid
        """Voxel that holds each point: voxel i of an axis covers [lower + i size, lower + (i + 1) size)."""
        lower, size = (constant(value, torch.float64, xyz.device) for value in (self.lower_m, self.voxel_m))
        return ((xyz.double() - lower) / size).floor().long().flip(-1)

    def centre_of(
        self,
        cells: Tensor,  # [..., 3] int64 (z, row, col)
    ) -> Tensor:  # [..., 3] float32 (x, y, z) m
        """Centre of each voxel."""
        lower, size = (constant(value, torch.float32, cells.device) for value in (self.lower_m, self.voxel_m))
        return lower + (cells.flip(-1) + 0.5) * size

    def contains(
        self,
        xyz: Tensor,  # [..., 3] m
    ) -> Tensor:  # [...] bool
        """Whether each point lies in a voxel of the grid; what is not finite does not."""
        cells = self.cell_of(xyz.nan_to_num(nan=torch.inf))
        return ((cells >= 0) & (cells < constant(self.cells, torch.int64, xyz.device))).all(-1)

    def normalised(
        self,
        xyz: Tensor,  # [..., 3] m
    ) -> Tensor:  # [..., 3]
        """Positions with the region at -1..1 along every axis."""
        lower, upper = (constant(value, xyz.dtype, xyz.device) for value in (self.lower_m, self.upper_m))
        return 2 * (xyz - lower) / (upper - lower) - 1
