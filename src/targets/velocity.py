"""Velocity supervision: rasters of box velocities, read by Gaussians and cells (Eq. 9; method 6.2, 8.2)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.ops.segment_reduce import inverse_rows
from src.ops.sites import rows_of_keys
from src.structures.boxes import Boxes3D
from src.targets.occupancy import box_cell_keys
from src.targets.supervision import join_boxes, supervised_boxes


@dataclass
class VelocityRaster:
    """Velocities of the cells in boxes."""

    keys: Tensor  # [P] int64 linear keys (b * rows + row) * cols + col, sorted, unique
    velocities: Tensor  # [P, 2] m/s over ground, augmented axes; NaN where unknown

    def at(
        self,
        keys: Tensor,  # [q] int64 linear keys; -1 for none
    ) -> Tensor:  # [q, 2]
        """Target velocity at cells; NaN, that is unsupervised, outside every box and where it is unknown.

        At p*_i, the cell where Gaussian i contributes most, in the raster of the enlarged boxes: the target of Eq. 9.
        """
        rows = rows_of_keys(self.keys, keys)
        padded = torch.cat([self.velocities, self.velocities.new_full((1, 2), torch.nan)])
        return padded[rows]  # row -1 is the padding


def velocity_raster(
    boxes: list[Boxes3D],  # B, augmented ego frame
    grid: BEVGrid,
    margin_m: float,
) -> VelocityRaster:
    """Box velocities on the cells of the boxes, enlarged by `margin_m` in total; see `box_of_cells` for overlaps."""
    joined, batch = supervised_boxes(boxes, grid)
    keys, owners = box_of_cells(joined, batch, grid, margin_m)
    return VelocityRaster(keys, joined.velocities[owners])


def on_open_ground(
    keys: Tensor,  # [q] int64 linear keys; -1 for none
    boxes: list[Boxes3D],  # B, augmented ego frame
    grid: BEVGrid,
    margin_m: float,
) -> Tensor:  # [q] bool
    """Which cells no enlarged box covers, supervised or not: whatever returns are there, nothing annotated moves."""
    joined = join_boxes(boxes)
    batch = torch.repeat_interleave(torch.tensor([len(sample) for sample in boxes], device=keys.device))
    covered = torch.unique(box_cell_keys(joined, batch, grid, margin_m)[1])
    return (keys >= 0) & (rows_of_keys(covered, keys) < 0)


def box_of_cells(
    boxes: Boxes3D,  # K boxes of a batch
    batch: Tensor,  # [K] int64
    grid: BEVGrid,
    margin_m: float,
) -> tuple[Tensor, Tensor]:  # [P] int64 linear keys, sorted, unique; [P] int64 row of the box
    """The box that each covered cell takes its velocity from.

    A box itself comes before the margin of another, so that a sign does not learn the speed of the car that passes it.
    Among boxes, and among margins, the faster one wins (CRT-Fusion), and one of unknown velocity over all.
    """
    order = boxes.velocities.norm(dim=1).nan_to_num(nan=torch.inf).argsort(descending=True, stable=True)
    rank = inverse_rows(order, len(boxes))
    codes = []  # (cell, whether only in the margin, rank) as one number
    for in_margin, enlarged_m in enumerate(sorted({0.0, margin_m})):
        owners, keys = box_cell_keys(boxes, batch, grid, enlarged_m)
        codes.append((2 * keys + in_margin) * len(boxes) + rank[owners])
    code = torch.cat(codes).sort().values
    keys = torch.div(code, 2 * max(len(boxes), 1), rounding_mode="floor")
    first = torch.ones_like(keys, dtype=torch.bool)
    first[1:] = keys[1:] != keys[:-1]
    return keys[first], order[code[first] % max(len(boxes), 1)]
