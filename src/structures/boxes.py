"""3D boxes of one sample, in one frame."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from src.structures.tensor_fields import TensorFields


@dataclass
class Boxes3D(TensorFields):
    """K boxes in the ego or augmented ego frame of one sample.

    Ground truth carries `num_points` (lidar + radar returns), predictions carry `scores`.
    Raises ValueError when shapes disagree.
    """

    centers: Tensor  # [K, 3] m, box centre
    sizes: Tensor  # [K, 3] m (length, width, height)
    yaws: Tensor  # [K] rad, counter-clockwise from +x
    velocities: Tensor  # [K, 2] m/s over ground, NaN where unknown
    labels: Tensor  # [K] int64, index into taxonomy.CLASSES
    attributes: Tensor  # [K] int64, index into taxonomy.ATTRIBUTES, -1 for none
    scores: Tensor | None = None  # [K] in 0..1
    num_points: Tensor | None = None  # [K] int64

    def __post_init__(self) -> None:
        widths = {"centers": (3,), "sizes": (3,), "velocities": (2,)}
        for field in fields(self):
            value, shape = getattr(self, field.name), (len(self), *widths.get(field.name, ()))
            if value is not None and tuple(value.shape) != shape:
                raise ValueError(f"Boxes3D.{field.name} must be {list(shape)}, but got {list(value.shape)}")

    def __len__(self) -> int:
        return self.centers.shape[0]

    @classmethod
    def empty(cls) -> Boxes3D:
        """No box at all; scores and num_points are present and empty."""
        floats = {"centers": (0, 3), "sizes": (0, 3), "yaws": (0,), "velocities": (0, 2), "scores": (0,)}
        integers = ("labels", "attributes", "num_points")
        return cls(
            **{name: torch.zeros(shape) for name, shape in floats.items()},
            **{name: torch.zeros(0, dtype=torch.int64) for name in integers},
        )

    def __getitem__(self, rows: Tensor) -> Boxes3D:
        """The boxes at `rows` (a boolean mask or indices)."""
        if rows.dtype == torch.bool:
            rows = rows.nonzero().squeeze(1)  # once: each field's mask would make a GPU wait
        return self.map(lambda value: value[rows])

    def bev(self) -> Tensor:
        """Footprints [K, 5]: x, y, length, width, yaw."""
        return torch.cat([self.centers[:, :2], self.sizes[:, :2], self.yaws[:, None]], dim=1)

    def transform(
        self,
        dst_from_src: Tensor,  # [4, 4] rotation, reflection and uniform scale, with translation
    ) -> Boxes3D:
        """The boxes seen in another frame whose z axis stays vertical; velocities and sizes take the linear part.

        Method 9: sizes are scaled, a heading becomes the direction of its transformed unit vector.
        """
        matrix = dst_from_src.to(self.centers.dtype)
        linear, planar = matrix[:3, :3], matrix[:2, :2]
        scale = torch.linalg.det(linear).abs() ** (1 / 3)
        heading = torch.stack([self.yaws.cos(), self.yaws.sin()], dim=1) @ planar.T
        return replace(
            self,
            centers=self.centers @ linear.T + matrix[:3, 3],
            sizes=self.sizes * scale,
            yaws=torch.atan2(heading[:, 1], heading[:, 0]),
            velocities=self.velocities @ planar.T,
        )
