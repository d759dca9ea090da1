"""The bird's-eye-view grid: cells, their centres and the range they cover (Table 10, Table 12)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from src.errors import ConfigError
from src.geometry.constants import constant


@dataclass(frozen=True)
class BEVGrid:
    """Square cells over the ground plane of the (augmented) ego frame; x runs along columns, y along rows.

    `cells` is (rows, cols), `cell_m` the edge in metres, `centre_m` the (x, y) of the grid's centre, `z_range_m` the
    height band [low, high) that radar voxels and sampling heights use.

    Raises ConfigError for a grid without cells, a cell edge that is not positive or an empty height band.
    """

    cells: tuple[int, int]
    cell_m: float
    centre_m: tuple[float, float]
    z_range_m: tuple[float, float]

    def __post_init__(self) -> None:
        if len(self.cells) != 2 or min(self.cells) < 1:
            raise ConfigError(f"grid.cells={self.cells}: must be two positive numbers [rows, columns]")
        if not (math.isfinite(self.cell_m) and self.cell_m > 0):
            raise ConfigError(f"grid.cell_m={self.cell_m}: must be a positive number of metres")
        if len(self.centre_m) != 2 or not all(math.isfinite(value) for value in self.centre_m):
            raise ConfigError(f"grid.centre_m={self.centre_m}: must be two numbers [x, y] in metres")
        if len(self.z_range_m) != 2 or not self.z_range_m[0] < self.z_range_m[1]:
            raise ConfigError(f"grid.z_range_m={self.z_range_m}: must be [low, high] in metres with low < high")

    @property
    def rows(self) -> int:
        """Number of cells along y."""
        return self.cells[0]

    @property
    def cols(self) -> int:
        """Number of cells along x."""
        return self.cells[1]

    @property
    def x_min_m(self) -> float:
        """Lower edge of column 0."""
        return self.centre_m[0] - 0.5 * self.cols * self.cell_m

    @property
    def y_min_m(self) -> float:
        """Lower edge of row 0."""
        return self.centre_m[1] - 0.5 * self.rows * self.cell_m

    @property
    def half_extent_m(self) -> tuple[float, float]:
        """Half the range along (x, y); 153.6 m at the paper's 384 cells."""
        return 0.5 * self.cols * self.cell_m, 0.5 * self.rows * self.cell_m

    def to_cells(
        self,
        xy: Tensor,  # [..., 2] metres
    ) -> Tensor:  # [..., 2] (x, y) in cells, continuous, measured from the grid's lower corner
        """Grid coordinates g = (xy - lower corner) / cell; cell (row, col) spans [col, col+1) x [row, row+1)."""
        return (xy - constant((self.x_min_m, self.y_min_m), xy.dtype, xy.device)) / self.cell_m

    def cell_of(
        self,
        xy: Tensor,  # [..., 2] metres
    ) -> Tensor:  # [..., 2] int64 (row, col), possibly outside the grid
        """Cell that holds each point; combine with `contains` for points that may lie outside."""
        return self.to_cells(xy).floor().long().flip(-1)

    def contains(
        self,
        xy: Tensor,  # [..., 2] metres
    ) -> Tensor:  # [...] bool
        """Whether each point lies in a cell of the grid; NaN does not."""
        g = self.to_cells(xy)
        return ((g >= 0) & (g < constant((self.cols, self.rows), g.dtype, g.device))).all(-1)

    def contains_points(
        self,
        points: Tensor,  # [..., 3 or more] x, y, z in metres
    ) -> Tensor:  # [...] bool
        """Whether each point lies in a cell of the grid and in the height band; NaN does not."""
        low, high = self.z_range_m
        return self.contains(points[..., :2]) & (points[..., 2] >= low) & (points[..., 2] < high)

    def keys_of(
        self,
        samples: Tensor,  # [...] int64
        cells: Tensor,  # [..., 2] int64 (row, col) in the grid
    ) -> Tensor:  # [...] int64
        """Linear index of each cell among those of all samples, row by row."""
        return (samples * self.rows + cells[..., 0]) * self.cols + cells[..., 1]

    def centre_of(
        self,
        cells: Tensor,  # [..., 2] (row, col)
        dtype: torch.dtype = torch.float32,
    ) -> Tensor:  # [..., 2] (x, y) metres
        """Centre of each cell."""
        if cells.device.type != "cpu":  # where a launch costs more than another rounding
            first = (self.x_min_m + 0.5 * self.cell_m, self.y_min_m + 0.5 * self.cell_m)
            return torch.add(constant(first, dtype, cells.device), cells.flip(-1), alpha=self.cell_m)
        lower = constant((self.x_min_m, self.y_min_m), dtype, cells.device)
        return lower + (cells.flip(-1).to(dtype) + 0.5) * self.cell_m
