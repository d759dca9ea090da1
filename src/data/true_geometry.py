"""What a synthetic world knows beside its recordings: where matter is, and how it moves, at any place and time."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from src.errors import DataError
from src.files.atomic_write import replacing

Array = np.ndarray

TRUTH_FOLDER = "truth"
RATE_STEP_S = 0.01
"""Half the interval over which a box's motion at a point is differenced."""


@dataclass(kw_only=True)
class TrueGeometry:
    """Solid matter of one scene: N upright boxes over time, and the ground. Global axes, z up, relative to `origin`."""

    origin: Array  # [3] float64 m, global
    times_us: Array  # [T] int64, ascending
    middles: Array  # [T, N, 3] float32 m
    yaws: Array  # [T, N] float32 rad, without turns of 2 pi from step to step
    sizes: Array  # [N, 3] float32 m: length, width, height
    ground: Array  # [rows, cols] float32 m, height at the corners of square cells; y along rows, x along columns
    ground_corner: Array  # [2] float64 m, x and y of the first
    ground_cell_m: Array  # [] float64

    def write(self, root: Path, scene: str) -> None:
        """Store it with a data set; the same content gives the same bytes."""
        with replacing(root / TRUTH_FOLDER / f"{scene}.npz", "wb") as file:
            np.savez_compressed(file, **vars(self))

    @classmethod
    def read(cls, root: Path, scene: str) -> TrueGeometry:
        """That of a scene of a data set. Raises DataError where the data set does not know it."""
        path = root / TRUTH_FOLDER / f"{scene}.npz"
        try:
            with np.load(path, allow_pickle=False) as arrays:
                return cls(**{field.name: arrays[field.name] for field in fields(cls)})
        except FileNotFoundError as error:
            raise DataError(
                f"{path}: no such file; only a synthetic world with data.world.lidar=true knows its true geometry"
            ) from error
        except Exception as error:  # numpy and zipfile raise all kinds for what is no whole archive of arrays
            raise DataError(f"{path}: not the true geometry of a scene ({error}); write the world again") from error

    def solid(
        self,
        points: Array,  # [Q, 3] float64 m, global
        times_us: Array,  # [Q] int64
    ) -> Array:  # [Q] bool
        """Whether each point lies in a box or under the ground at its time. Raises ValueError outside the scene."""
        local = points - self.origin
        return (self._boxes_of(local, times_us, 0.0) >= 0) | (local[:, 2] < self.ground_height(points))

    def velocities(
        self,
        points: Array,  # [Q, 3] float64 m, global
        times_us: Array,  # [Q] int64
        margin_m: float,  # boxes are grown by this on each side, for points that were measured
    ) -> Array:  # [Q, 3] m/s, global axes
        """How the matter at each point moves at its time: that of the box around it, zero elsewhere."""
        local, moving = points - self.origin, np.zeros((len(points), 3))
        boxes = self._boxes_of(local, times_us, margin_m)
        held = np.flatnonzero(boxes >= 0)
        middles, yaws = self._poses(boxes[held], times_us[held])
        own = _turned(local[held] - middles, -yaws)
        span_us, limits = round(1e6 * RATE_STEP_S), (self.times_us[0], self.times_us[-1])
        ends_us = [np.clip(times_us[held] + sign * span_us, *limits) for sign in (-1, 1)]
        before, after = (
            middle + _turned(own, yaw) for middle, yaw in (self._poses(boxes[held], end) for end in ends_us)
        )
        moving[held] = (after - before) / (1e-6 * (ends_us[1] - ends_us[0]))[:, None]
        return moving

    def ground_height(
        self,
        points: Array,  # [Q, 2 or more] m, global
    ) -> Array:  # [Q] m relative to the origin
        """Height of the ground, level beyond what is known of it."""
        place = (points[:, :2] - self.origin[:2] - self.ground_corner) / self.ground_cell_m
        x, y = np.clip(place, 0, np.array(self.ground.shape[::-1]) - 1.001).T
        col, row = x.astype(np.int64), y.astype(np.int64)
        right, up = x - col, y - row
        low = (1 - right) * self.ground[row, col] + right * self.ground[row, col + 1]
        high = (1 - right) * self.ground[row + 1, col] + right * self.ground[row + 1, col + 1]
        return (1 - up) * low + up * high

    def _boxes_of(self, local: Array, times_us: Array, margin_m: float) -> Array:  # [Q] int64, -1 for none
        """The box that holds each point, the last where several do."""
        found = np.full(len(local), -1)
        if not len(local):
            return found
        first, last = times_us.min(), times_us.max()
        if first < self.times_us[0] or last > self.times_us[-1]:
            raise ValueError(
                f"times_us from {first} to {last}: the geometry of this scene is known from {self.times_us[0]} to "
                f"{self.times_us[-1]}"
            )
        steps = slice(
            max(0, int(np.searchsorted(self.times_us, first, "right")) - 1),
            int(np.searchsorted(self.times_us, last)) + 1,
        )
        around = 0.5 * np.hypot(*self.sizes[:, :2].T) + 1.5 * margin_m
        low, high = self.middles[steps].min(0) - around[:, None], self.middles[steps].max(0) + around[:, None]  # [N, 3]
        order = np.argsort(local[:, 0])
        ordered = local[order, 0]
        starts, ends = np.searchsorted(ordered, low[:, 0]), np.searchsorted(ordered, high[:, 0])
        for box in np.flatnonzero(ends > starts):
            rows = order[starts[box] : ends[box]]
            rows = rows[(local[rows, 1] >= low[box, 1]) & (local[rows, 1] <= high[box, 1])]
            middles, yaws = self._poses(np.full(len(rows), box), times_us[rows])
            own = np.abs(_turned(local[rows] - middles, -yaws))
            found[rows[(own <= 0.5 * self.sizes[box] + margin_m).all(1)]] = box
        return found

    def _poses(self, boxes: Array, times_us: Array) -> tuple[Array, Array]:  # [Q, 3], [Q]
        """Middles and headings of boxes [Q], each at its own time, linear between steps."""
        after = np.clip(np.searchsorted(self.times_us, times_us, "right"), 1, len(self.times_us) - 1)
        before = after - 1
        part = (times_us - self.times_us[before]) / (self.times_us[after] - self.times_us[before])
        share, rows = (1.0 - part, part), ((before, boxes), (after, boxes))
        middles = sum(weight[:, None] * self.middles[row] for weight, row in zip(share, rows, strict=True))
        return middles, sum(weight * self.yaws[row] for weight, row in zip(share, rows, strict=True))


def _turned(vectors: Array, yaws: Array) -> Array:  # [Q, 3]
    """Vectors [Q, 3] turned about z by [Q] rad."""
    cos, sin = np.cos(yaws), np.sin(yaws)
    x, y, z = vectors.T
    return np.stack([cos * x - sin * y, sin * x + cos * y, z], 1)
