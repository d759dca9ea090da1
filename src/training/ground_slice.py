"""Places at one height above the ground about the ego, in the frames that models and truths speak of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from src.data.true_geometry import TrueGeometry
from src.geometry.bounds import Bounds
from src.structures.batch import FrameBatch
from src.structures.ray_bundle import RayBundle

Array = np.ndarray

Window = tuple[tuple[float, float], tuple[float, float]]
"""(low, high) along x and along y, m."""
HEIGHT_M = 1.0
SLACK_M = 0.5
"""A ray tells of places that it passes within this height above or below."""
DEPTH_M = 1.0
"""A ray also tells of places up to this far behind its return."""


@dataclass
class GroundSlice:
    """n places HEIGHT_M above the ground about one sample of a batch, a square lattice cut to a model's bounds."""

    in_aug: Tensor  # [n, 3] float32 m, frame of the sample
    in_global: Array  # [n, 3] float64 m
    cell_m: float
    sample: int
    timestamp_s: float  # of the sample

    @classmethod
    def of(
        cls,
        batch: FrameBatch,
        sample: int,
        truth: TrueGeometry | None,  # that knows the ground; None: level ground under the ego
        bounds: Bounds,
        window: Window,
        cell_m: float,
    ) -> GroundSlice:
        low, high = np.maximum([x[0] for x in window], [x[0] for x in bounds[:2]]), [x[1] for x in window]
        high = np.minimum(high, [x[1] for x in bounds[:2]])
        axes = [np.arange(start + 0.5 * cell_m, end, cell_m) for start, end in zip(low, high, strict=True)]
        x, y = (values.ravel() for values in np.meshgrid(*axes, indexing="ij"))
        matrix = global_from_aug(batch, sample)
        in_global = np.stack([x, y, np.full_like(x, HEIGHT_M)], 1) @ matrix[:3, :3].T + matrix[:3, 3]
        if truth is not None:
            in_global[:, 2] = truth.origin[2] + truth.ground_height(in_global) + HEIGHT_M
        in_aug = (in_global - matrix[:3, 3]) @ matrix[:3, :3]
        inside = (in_aug[:, 2] >= bounds[2][0]) & (in_aug[:, 2] < bounds[2][1])
        found, time_s = torch.from_numpy(in_aug[inside]).float(), float(batch.timestamps_s[sample])
        return cls(found, in_global[inside], cell_m, sample, time_s)

    def queries(self, time_s: float, device: torch.device) -> tuple[Tensor, Tensor]:  # [n, 4], [n]
        """The places at a time after the sample's frame and their sample, as `WorldModel.look_up` takes them."""
        times = self.in_aug.new_full((len(self.in_aug), 1), time_s)
        owner = torch.full((len(self.in_aug),), self.sample, device=device)
        return torch.cat([self.in_aug, times], 1).to(device), owner

    def solid(self, truth: TrueGeometry, time_s: float) -> Array:  # [n] bool
        """Which places are solid at a time after the sample's frame, by the true geometry."""
        times_us = np.full(len(self.in_global), round(1e6 * (self.timestamp_s + time_s)))
        return truth.solid(self.in_global, times_us)

    def reached(self, rays: RayBundle) -> Array:  # [n] bool
        """Which places the sample's rays passed or met: of others nothing is known."""
        low = self.in_aug[:, :2].min(0).values - 0.5 * self.cell_m
        cells = ((self.in_aug[:, :2] - low) / self.cell_m).long()
        rows = torch.full((cells.max(0).values + 1).tolist(), -1)
        rows[cells[:, 0], cells[:, 1]] = torch.arange(len(cells))
        found = torch.zeros(len(cells), dtype=torch.bool)
        origins, directions = rays.origins.cpu(), rays.directions.cpu()
        lengths = rays.ranges.cpu() + DEPTH_M
        for away in torch.arange(0, float(lengths.max()) if len(rays) else 0.0, 0.5 * self.cell_m).tolist():
            own = lengths > away
            points = origins[own] + away * directions[own]
            at = ((points[:, :2] - low) / self.cell_m).floor().long()
            inside = ((at >= 0) & (at < torch.tensor(rows.shape))).all(1)
            row = rows[at[inside, 0], at[inside, 1]]
            near = (points[inside, 2] - self.in_aug[row, 2]).abs() <= SLACK_M
            found[row[near & (row >= 0)]] = True
        return found.numpy()


def global_from_aug(batch: FrameBatch, sample: int) -> Array:  # [4, 4]
    """Transform from a sample's augmented ego frame to global coordinates, in float64."""
    matrix = batch.global_from_ego[sample] @ torch.linalg.inv(batch.aug_from_ego[sample].double())
    return matrix.cpu().numpy()
