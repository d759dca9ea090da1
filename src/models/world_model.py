"""What a model of space and time offers beside, or in place of, boxes: answers at places, and forecasts of LiDAR."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from torch import Tensor

from src.geometry.bounds import Bounds
from src.structures.ray_bundle import RayBundle


class WorldModel(ABC):
    """A model of what is where and when; a detector may be one as well.

    `output` is that of its `forward`, and everything is in the batch's frames.
    """

    @property
    @abstractmethod
    def bounds(self) -> Bounds:
        """The region that the model knows of."""

    @property
    @abstractmethod
    def forecasts(self) -> bool:
        """Whether the model has learnt to `forecast`."""

    @abstractmethod
    def look_up(
        self,
        output: Any,
        queries: Tensor,  # [Q, 4] x, y, z m and t s from the frame's time
        batch: Tensor,  # [Q] int64, sample of each
    ) -> tuple[Tensor, Tensor | None]:  # [Q], [Q]
        """Probability that each place is occupied; radial velocity there, m/s, None where none is predicted."""

    @abstractmethod
    def forecast(
        self,
        output: Any,
        rays: RayBundle,  # whose origins, directions, times and samples are read
    ) -> Tensor:  # [R] m
        """Ranges that a LiDAR will measure. Raises ConfigError for a model that has not learnt this."""
