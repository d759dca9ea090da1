"""The set of 2D Gaussians on the BEV plane that the model refines and splats (Eq. 1)."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from src.geometry.tensor_transforms import transform_points_xy, transform_vectors_xy
from src.structures.tensor_fields import TensorFields


@dataclass
class GaussianSet(TensorFields):
    """G Gaussians for each of B samples (Eq. 1); attributes hold physical values, opacity its logit.

    Rows with `valid` False are padding and never take part in attention, splatting or losses.
    Raises ValueError when shapes disagree.
    """

    means: Tensor  # [B, G, 2] m, augmented ego frame
    scales: Tensor  # [B, G, 2] m, standard deviation along and across `directions`
    directions: Tensor  # [B, G, 2] (cos, sin) of the rotation, unit length
    opacity_logits: Tensor  # [B, G]
    velocities: Tensor  # [B, G, 2] m/s over ground, augmented ego axes
    features: Tensor  # [B, G, C]
    sources: Tensor  # [B, G] int64, see `taxonomy.Source`
    elapsed_s: Tensor  # [B, G] age of the observation, 0 for the current frame
    valid: Tensor  # [B, G] bool

    def __post_init__(self) -> None:
        b, g = self.valid.shape
        widths = {name: (2,) for name in ("means", "scales", "directions", "velocities")}
        widths["features"] = self.features.shape[-1:]
        for field in fields(self):
            value, shape = getattr(self, field.name), (b, g, *widths.get(field.name, ()))
            if tuple(value.shape) != shape:
                raise ValueError(f"GaussianSet.{field.name} must be {list(shape)}, but got {list(value.shape)}")
        if self.valid.dtype != torch.bool:
            raise ValueError(f"GaussianSet.valid must be bool, but got {self.valid.dtype}")

    def __len__(self) -> int:
        return self.valid.shape[1]

    def valid_rows(self) -> Tensor:  # [V] int64
        """Rows in B * G of what is no padding, ascending. Waits for a GPU."""
        return self.valid.flatten().nonzero().squeeze(1)

    def transform(
        self,
        dst_from_src: Tensor,  # [B, 4, 4] rotation, reflection and uniform scale, with translation
    ) -> GaussianSet:
        """The Gaussians seen in another frame; the z = 0 plane is kept (method 6.2, 9).

        Directions become those of their transformed unit vectors, scales and velocities take the scale along.
        """
        matrix = dst_from_src[:, None].to(self.means.dtype)  # [B, 1, 4, 4]
        scale = torch.linalg.det(matrix[..., :2, :2]).abs().sqrt()[..., None]
        return replace(
            self,
            means=transform_points_xy(matrix, self.means),
            scales=self.scales * scale,
            directions=F.normalize(transform_vectors_xy(matrix, self.directions), dim=-1),
            velocities=transform_vectors_xy(matrix, self.velocities),
        )

    @classmethod
    def empty(cls) -> GaussianSet:
        """No Gaussian of one sample, without features."""
        pairs = {name: torch.zeros(1, 0, 2) for name in ("means", "scales", "directions", "velocities")}
        single = {name: torch.zeros(1, 0) for name in ("opacity_logits", "elapsed_s")}
        sources, valid = torch.zeros(1, 0, dtype=torch.int64), torch.zeros(1, 0, dtype=torch.bool)
        return cls(**pairs, **single, features=torch.zeros(1, 0, 0), sources=sources, valid=valid)
