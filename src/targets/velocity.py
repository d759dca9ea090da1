"""Velocity supervision: rasters of box velocities, read by Gaussians and cells (Eq. 9; method 6.2, 8.2)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.ops.sites import rows_of_keys
from src.structures.boxes import Boxes3D
from src.targets.occupancy import box_cell_keys
from src.targets.supervision import supervised_boxes


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
    """Paint box velocities on the cells of the boxes, enlarged by `margin_m` in total.

    Where boxes overlap the faster one wins, and one of unknown velocity over all: its cells supervise nothing.
    """
    joined, batch = supervised_boxes(boxes, grid)
    owners, keys = box_cell_keys(joined, batch, grid, margin_m)
    speed = joined.velocities.norm(dim=1).nan_to_num(nan=torch.inf)[owners]
    order = speed.argsort(descending=True, stable=True)
    order = order[keys[order].argsort(stable=True)]
    keys = keys[order]
    first = torch.ones_like(keys, dtype=torch.bool)
    first[1:] = keys[1:] != keys[:-1]
    return VelocityRaster(keys[first], joined.velocities[owners[order[first]]])
