"""Points of radar and LiDAR sweeps as the tensors of a batch of one (method 1.3)."""

from __future__ import annotations

import numpy as np
import torch

from src.data.compensation import Sweeps, compensate_clouds, place_sweep
from src.geometry.transforms import invert_rigid
from src.structures.batch import LIDAR_POINT_FIELDS, RADAR_POINT_FIELDS

Array = np.ndarray


def radar_tensors(
    sweeps: Sweeps,
    ages_s: Array,  # [S] key frame minus sweep
    global_from_ego: Array,  # [4, 4] ego(t)
    aug_from_ego: Array,  # [4, 4]
    min_distance_m: float,  # as `ReaderOptions`
    propagate_points: bool,
) -> dict[str, torch.Tensor]:
    """The radar of a batch of one: moved to ego(t), compensated for the ego motion by the full mount (method 1.3)."""
    points = np.zeros((0, len(RADAR_POINT_FIELDS)))
    if sweeps.clouds:
        ego_from_global = invert_rigid(global_from_ego)
        points = compensate_clouds(sweeps, ego_from_global, ages_s, min_distance_m, propagate_points)
        linear = aug_from_ego[:3, :3]
        points[:, :3] = points[:, :3] @ linear.T + aug_from_ego[:3, 3]
        points[:, 4:6] = points[:, 4:6] @ linear[:2, :2].T
    owners = torch.zeros(len(points), dtype=torch.int64)
    return {"radar_points": torch.from_numpy(points.astype(np.float32, order="C")), "radar_batch": owners}


def lidar_tensors(
    sweeps: Sweeps,
    ages_s: list[Array],  # S of [n] key frame's time less the point's
    offsets_s: list[Array],  # S of [n] the point's time less that of its sweep's pose
    aug_from_global: Array,  # [4, 4]
    min_distance_m: float,  # as `ReaderOptions`
    origins: bool,
) -> dict[str, torch.Tensor]:
    """The LiDAR of a batch of one, in the (augmented) ego frame of the key frame."""
    placed = [(np.zeros((0, len(LIDAR_POINT_FIELDS)), np.float32), np.zeros((0, 3), np.float32))]
    mounts, targets = sweeps.ego_from_sensor, aug_from_global @ sweeps.global_from_ego
    columns = (sweeps.clouds, ages_s, offsets_s, mounts, targets, sweeps.velocity, sweeps.rate)
    placed += [place_sweep(*sweep, min_distance_m, origins) for sweep in zip(*columns, strict=True)]
    points, starts = zip(*placed, strict=True)
    tensors = {"lidar_points": torch.from_numpy(np.concatenate(points))}
    tensors["lidar_batch"] = torch.zeros(len(tensors["lidar_points"]), dtype=torch.int64)
    if origins:
        tensors["lidar_origins"] = torch.from_numpy(np.concatenate(starts))
    return tensors
