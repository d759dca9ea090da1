"""Which annotations supervise the model (method 4.3, 7, 8.2)."""

from __future__ import annotations

from dataclasses import fields

import torch
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.structures.boxes import Boxes3D


def supervised_boxes(
    boxes: list[Boxes3D],  # B, augmented ego frame
    grid: BEVGrid,
) -> tuple[Boxes3D, Tensor]:  # K boxes of all samples, [K] int64 sample of each, ascending
    """Join the boxes of a batch that lie in the grid, were seen and have an extent.

    A box without any lidar or radar point (`num_points` 0), with its centre outside the grid, with a value that is
    not finite (velocities excepted) or with a size of zero supervises nothing. `num_points` None counts as seen.
    """
    kept = []
    for sample in boxes:
        usable = grid.contains(sample.centers[:, :2]) & (sample.sizes > 0).all(1)
        values = torch.cat([sample.centers, sample.sizes, sample.yaws[:, None]], dim=1)
        usable &= values.isfinite().all(1)
        if sample.num_points is not None:
            usable &= sample.num_points > 0
        kept.append(sample[usable])
    counts = torch.tensor([len(sample) for sample in kept], device=kept[0].centers.device)
    return join_boxes(kept), torch.repeat_interleave(counts)


def join_boxes(
    parts: list[Boxes3D],  # at least one
) -> Boxes3D:
    """One table of the boxes of all parts, in order; an optional column that a part lacks is dropped."""
    columns = {field.name: [getattr(part, field.name) for part in parts] for field in fields(Boxes3D)}
    complete = {name: all(value is not None for value in values) for name, values in columns.items()}
    return Boxes3D(**{name: torch.cat(values) if complete[name] else None for name, values in columns.items()})
