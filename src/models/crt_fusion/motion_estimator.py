"""Motion feature estimator of CRT-Fusion: where objects are on the map and how they move (its Sec. 3.3)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor, nn

from src.losses.normalizers import mean_over_ranks
from src.losses.regression import masked_l1
from src.models.layers.dense import DenseConvNormReLU, rows_of_map
from src.models.layers.full_precision import FullPrecisionConv2d
from src.structures.taxonomy import SPEED_UNIT_MPS
from src.targets.box_raster import BoxRaster

OCCUPANCY_BIAS = -4.6
"""An untrained cell is occupied with probability 0.01, below the threshold of the memory."""


@dataclass
class CellMotion:
    """What every cell of the map is predicted to hold."""

    occupancy_logits: Tensor  # [M] float32, M = B * rows * cols
    velocities: Tensor  # [M, 2] float32, m/s over ground, augmented axes


class MotionEstimator(nn.Module):
    """One 3x3 convolution, then occupancy and velocity of each cell (MFE)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.hidden = DenseConvNormReLU(channels, channels, 3)
        self.output = FullPrecisionConv2d(channels, 3, 1)
        nn.init.zeros_(self.output.bias)
        nn.init.constant_(self.output.bias[:1], OCCUPANCY_BIAS)

    def forward(
        self,
        fused: Tensor,  # [B, C, rows, cols]
    ) -> CellMotion:
        occupancy, velocity = rows_of_map(self.output(self.hidden(fused))).split([1, 2], dim=1)
        return CellMotion(occupancy.squeeze(1), SPEED_UNIT_MPS * velocity)


def velocity_loss(motion: CellMotion, raster: BoxRaster) -> Tensor:  # []
    """Mean absolute error of the known velocities of the cells in boxes; the faster of several boxes counts."""
    errors = masked_l1(motion.velocities[raster.keys], raster.velocities)
    return errors.sum() / mean_over_ranks((~raster.velocities.isnan()).sum())
