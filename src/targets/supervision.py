"""Which annotations supervise the model (method 4.3, 7, 8.2)."""

from __future__ import annotations

from dataclasses import fields

import torch
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.geometry.constants import on_device, upload
from src.structures.boxes import Boxes3D


def supervised_boxes(
    boxes: list[Boxes3D] | None,  # B, augmented ego frame
    grid: BEVGrid,
) -> tuple[Boxes3D, Tensor]:  # K boxes of all samples, [K] int64 sample of each, ascending
    """Join the boxes of a batch that lie in the grid, were seen and have an extent.

    A box without any lidar or radar point (`num_points` 0), with its centre outside the grid, with a value that is
    not finite (velocities excepted) or with a size of zero supervises nothing. `num_points` None counts as seen.

    Raises ValueError for a batch without annotations.
    """
    if boxes is None:
        raise ValueError("FrameBatch.boxes is None, but a loss needs annotations")
    joined, sample = join_boxes(boxes), box_samples(boxes)
    usable = grid.contains(joined.centers[:, :2]) & (joined.sizes > 0).all(1)
    values = torch.cat([joined.centers, joined.sizes, joined.yaws[:, None]], dim=1)
    usable &= values.isfinite().all(1)
    seen = [torch.ones_like(part.labels) if part.num_points is None else part.num_points for part in boxes]
    usable &= torch.cat(seen) > 0
    rows = usable.nonzero().squeeze(1)
    return joined[rows], sample[rows]


def upload_boxes(
    boxes: Boxes3D,
    *tensors: Tensor,
    device: torch.device,
) -> tuple[Boxes3D, *tuple[Tensor, ...]]:
    """Boxes and what belongs to them on a device."""
    own = boxes.tensors()
    moved = upload([*own, *tensors], device)
    fields_of_boxes = iter(moved)
    return boxes.map(lambda _: next(fields_of_boxes)), *moved[len(own) :]


def box_samples(
    boxes: list[Boxes3D],
) -> Tensor:  # [K] int64, the sample of each box of all samples
    """The sample of each box of `join_boxes`."""
    owners = [row for row, sample in enumerate(boxes) for _ in range(len(sample))]
    return on_device(owners, torch.int64, boxes[0].centers.device)


def join_boxes(
    parts: list[Boxes3D],  # at least one
) -> Boxes3D:
    """One table of the boxes of all parts, in order; an optional column that a part lacks is dropped."""
    columns = {field.name: [getattr(part, field.name) for part in parts] for field in fields(Boxes3D)}
    complete = {name: all(value is not None for value in values) for name, values in columns.items()}
    return Boxes3D(**{name: torch.cat(values) if complete[name] else None for name, values in columns.items()})
