"""Rasters of boxes: which cells they cover, and the velocity of those (Eq. 9; method 5.6, 6.1, 6.2, 8.2)."""

from __future__ import annotations

from functools import cached_property

import torch
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.geometry.box_cells import cells_in_boxes
from src.geometry.constants import upload
from src.ops.segment_reduce import inverse_rows
from src.ops.sites import rows_of_keys
from src.structures.boxes import Boxes3D
from src.targets.supervision import box_samples, join_boxes, supervised_boxes, upload_boxes


class BoxRaster:
    """The cells of a batch that its supervised boxes cover, length and width enlarged by `margin_m` in total (epsilon).

    A cell takes its velocity from one box. A box itself comes before the margin of another, so that a sign does not
    learn the speed of the car that passes it. Among boxes, and among margins, the faster one wins (CRT-Fusion), and one
    of unknown velocity over all. Linear keys are (b * rows + row) * cols + col, -1 for no cell.
    """

    keys: Tensor  # [P] int64, covered cells, sorted, unique
    inside: Tensor  # [P] bool, in a box itself, not only in a margin
    velocities: Tensor  # [P, 2] m/s over ground, augmented axes; NaN where unknown
    boxes: Boxes3D  # K supervised boxes of all samples
    sample: Tensor  # [K] int64, the sample of each, ascending

    def __init__(
        self,
        annotated: list[Boxes3D],  # B, augmented ego frame
        grid: BEVGrid,
        margin_m: float,
        device: torch.device | None = None,  # of the cells that will be asked for; None: that of the boxes
    ) -> None:
        self.annotated, self.grid, self.margin_m = annotated, grid, margin_m
        self.device = annotated[0].centers.device if device is None else device
        boxes, sample = supervised_boxes(annotated, grid)
        num = max(len(boxes), 1)
        order = boxes.velocities.norm(dim=1).nan_to_num(nan=torch.inf).argsort(descending=True, stable=True)
        rank = inverse_rows(order, len(boxes))
        codes = []  # (cell, whether only in the margin, rank) as one number
        for in_margin, enlarged_m in enumerate(sorted({0.0, margin_m})):
            owners, keys = _box_cell_keys(boxes, sample, grid, enlarged_m)
            codes.append((2 * keys + in_margin) * num + rank[owners])
        code = torch.cat(codes).sort().values
        keys = torch.div(code, 2 * num, rounding_mode="floor")
        first = torch.ones_like(keys, dtype=torch.bool)
        first[1:] = keys[1:] != keys[:-1]
        rows = first.nonzero().squeeze(1)
        keys, code = keys[rows], code[rows]
        found = (sample, keys, code % (2 * num) < num, boxes.velocities[order[code % num]])
        self.boxes, self.sample, self.keys, self.inside, self.velocities = upload_boxes(
            boxes, *found, device=self.device
        )

    def in_boxes(
        self,
        keys: Tensor,  # [q] int64
    ) -> Tensor:  # [q] bool
        """Which cells lie in a box itself."""
        return self._at(self.inside, keys, False)

    def velocities_in_boxes(
        self,
        keys: Tensor,  # [q] int64
    ) -> Tensor:  # [q, 2]
        """Target velocity at cells; NaN, that is unsupervised, outside every box itself and where it is unknown."""
        return self._at(self.velocities.where(self.inside[:, None], torch.nan), keys, torch.nan)

    def velocities_in_margins(
        self,
        keys: Tensor,  # [q] int64
    ) -> Tensor:  # [q, 2]
        """Target velocity at cells; NaN outside every enlarged box and where it is unknown.

        At p*_i, the cell where Gaussian i contributes most, it is the target of Eq. 9.
        """
        return self._at(self.velocities, keys, torch.nan)

    def on_open_ground(
        self,
        keys: Tensor,  # [q] int64
    ) -> Tensor:  # [q] bool
        """Which cells no enlarged box covers, supervised or not: whatever returns there, nothing annotated moves."""
        return (keys >= 0) & (rows_of_keys(self._covered, keys) < 0)

    @cached_property
    def _covered(self) -> Tensor:  # [pairs] int64, sorted, cells of any enlarged box, repeated
        joined, sample = join_boxes(self.annotated), box_samples(self.annotated)
        return upload([_box_cell_keys(joined, sample, self.grid, self.margin_m)[1].sort().values], self.device)[0]

    def _at(self, values: Tensor, keys: Tensor, elsewhere: float) -> Tensor:
        rows = rows_of_keys(self.keys, keys)
        return torch.cat([values, values.new_full((1, *values.shape[1:]), elsewhere)])[rows]  # row -1 is the last


def _box_cell_keys(
    boxes: Boxes3D,  # K boxes of a batch
    batch: Tensor,  # [K] int64
    grid: BEVGrid,
    margin_m: float,
) -> tuple[Tensor, Tensor]:  # [pairs], [pairs] int64
    """All (box, cell) pairs, the cell as a linear key."""
    owners, cells, _ = cells_in_boxes(boxes.bev(), grid, margin_m)
    return owners, batch[owners] * (grid.rows * grid.cols) + cells
