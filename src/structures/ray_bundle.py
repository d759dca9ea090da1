"""LiDAR rays as supervision: where each began, where it went and what it met."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from src.structures.tensor_fields import TensorFields


@dataclass
class RayBundle(TensorFields):
    """R rays that returned, of B samples at several times, in each sample's own (augmented) ego frame (lrs 2.4).

    A step is a whole number of intervals of the timeline: 0 the sample's own frame, below 0 the past, above the future.
    Raises ValueError when shapes or types disagree.
    """

    origins: Tensor  # [R, 3] float32 m, where the sensor was when it measured
    directions: Tensor  # [R, 3] float32, unit length
    ranges: Tensor  # [R] float32 m, above 0
    times_s: Tensor  # [R] float32, the return's time after that of the sample's frame
    speeds: Tensor  # [R] float32 m/s over ground along the ray, above 0 for what moves away; NaN where unknown
    steps: Tensor  # [R] int64, the timeline's frame that the ray was measured for
    batch: Tensor  # [R] int64, sample of each ray, ascending

    def __post_init__(self) -> None:
        rays = len(self.ranges)
        for field in fields(self):
            value = getattr(self, field.name)
            shape = (rays, 3) if field.name in ("origins", "directions") else (rays,)
            dtype = torch.int64 if field.name in ("steps", "batch") else torch.float32
            if tuple(value.shape) != shape or value.dtype != dtype:
                raise ValueError(
                    f"RayBundle.{field.name} must be {list(shape)} {dtype}, but got {list(value.shape)} {value.dtype}"
                )

    def __len__(self) -> int:
        return len(self.ranges)

    @property
    def points(self) -> Tensor:  # [R, 3] m
        """Where the rays ended."""
        return self.origins + self.ranges[:, None] * self.directions

    def __getitem__(self, rows: Tensor) -> RayBundle:
        """Some of the rays, by a mask or by row."""
        return self.map(lambda value: value[rows])
