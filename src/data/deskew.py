"""LiDAR sweeps in the key frame's ego frame: a sweep takes a tenth of a second, in which the truck drives on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from src.structures.batch import LIDAR_POINT_FIELDS

Array = np.ndarray
Placed = tuple[Array, Array | None]
"""[n, 5] float32 in the order of LIDAR_POINT_FIELDS and, if asked for, [n, 3] float32 where the rays began (m)."""


def place_sweep(
    points: Array,  # [n, 4] float32: x, y, z (m, sensor frame), intensity
    *,
    ages_s: Array,  # [n] key frame's time less the point's
    offsets_s: Array,  # [n] the point's time less that of the sweep's pose; zeros leave the sweep as it is
    ego_from_sensor: Array,  # [4, 4]
    aug_from_sweep: Array,  # [4, 4] (augmented) ego frame of the key frame from the ego frame at the sweep's pose
    velocity: Array,  # [3] m/s of the ego at that pose, its own axes
    rate: Array,  # [3] rad/s, same axes
    min_distance_m: float,  # points nearer than this in both x and y of the sensor are dropped
    origins: bool,
) -> Placed:
    """Points of one sweep, each moved from the ego frame at its own time, and where the sensor was at that time."""
    kept = (np.abs(points[:, :2]) >= max(min_distance_m, 1e-6)).any(axis=1)
    points, ages_s, offsets_s = points[kept], ages_s[kept], offsets_s[kept].astype(np.float32)
    mount, target = ego_from_sensor.astype(np.float32), aug_from_sweep.astype(np.float32)

    def place(in_ego: Array) -> Array:  # [n, 3] -> [n, 3]
        return deskew(in_ego, offsets_s, velocity, rate) @ target[:3, :3].T + target[:3, 3]

    placed = np.empty((len(points), len(LIDAR_POINT_FIELDS)), np.float32)
    placed[:, :3] = place(points[:, :3] @ mount[:3, :3].T + mount[:3, 3])
    placed[:, 3] = points[:, 3]
    placed[:, 4] = ages_s
    return placed, place(np.broadcast_to(mount[:3, 3], (len(points), 3))) if origins else None


def deskew(
    points: Array,  # [n, 3] float32 m, ego frame at each point's own time
    offsets_s: Array,  # [n] float32, that time less the pose's
    velocity: Array,  # [3] m/s, ego axes
    rate: Array,  # [3] rad/s, ego axes
) -> Array:  # [n, 3] float32 m, ego frame at the pose
    """p + t (v + w x p) + t^2/2 w x (v + w x p): motion with the constant twist (v, w), to the second order.

    What is left out is a sixth of (|w| t)^3 of the range: 4 mm at 200 m, 0.5 rad/s and 0.1 s.
    """
    # As a matrix, row i is w x e_i: numpy's cross product is several times slower.
    cross_rate = np.cross(rate, np.eye(3)).astype(np.float32)
    moving = points @ cross_rate + velocity.astype(np.float32)
    t = offsets_s[:, None]
    return points + t * (moving + (0.5 * t) * (moving @ cross_rate))


def lidar_tensors(sweeps: Sequence[Placed], origins: bool) -> dict[str, torch.Tensor]:
    """The LiDAR of a batch of one."""
    nothing = np.zeros((0, len(LIDAR_POINT_FIELDS)), np.float32), np.zeros((0, 3), np.float32)
    points, starts = zip(*(sweeps or [nothing]), strict=True)
    tensors = {"lidar_points": torch.from_numpy(np.concatenate(points))}
    tensors["lidar_batch"] = torch.zeros(len(tensors["lidar_points"]), dtype=torch.int64)
    if origins:
        tensors["lidar_origins"] = torch.from_numpy(np.concatenate(starts))
    return tensors
