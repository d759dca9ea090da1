"""What every detector offers to training and evaluation: forward, loss, decode."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from torch import Tensor, nn

from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D


class Detector(nn.Module, ABC):
    """One frame in, boxes out. State between frames never lives on the module; the output is the model's own type."""

    @property
    def image_backbone(self) -> nn.Module | None:
        """The part trained at the backbone's own learning rate, None for a model without one."""
        return None

    @abstractmethod
    def forward(self, batch: FrameBatch) -> Any:  # each model returns its own dataclass
        """Everything that `loss` and `decode` need for the B frames of a batch."""

    @abstractmethod
    def loss(self, output: Any, batch: FrameBatch) -> dict[str, Tensor]:
        """Weighted loss terms by name, each a scalar, and their sum as `total`; needs `batch.boxes`."""

    @abstractmethod
    def decode(self, output: Any) -> list[Boxes3D]:
        """Predicted boxes with scores, one entry per sample, in the (augmented) ego frame."""

    def diagnostics(self, output: Any) -> dict[str, Tensor]:
        """Scalars worth a curve that are no losses."""
        return {}
