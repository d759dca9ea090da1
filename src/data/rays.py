"""LiDAR returns as rays, and how fast what they met moves along them (lrs 2.4, 2.5)."""

from __future__ import annotations

import numpy as np
import torch

from src.data.pcd import LidarCloud
from src.geometry.neighbours import neighbours_within
from src.structures.ray_bundle import RayBundle
from src.structures.taxonomy import EGO_BODY_M

Array = np.ndarray

RADAR_RADIUS_M = 2.0
RADAR_WINDOW_S = 0.06
"""A radar return tells the speed of a LiDAR return that is no further in xy and in time (lrs 2.5)."""
RADAR_LEAST_HEIGHT_M = 0.3
"""And that is not lower than this above the ego's ground: the height of a radar return is noise, and the road beside a
car would drive along, a third of all that seems to move [ours]."""
MAX_RADIAL_MPS = 60.0
"""Faster returns are ambiguous Doppler (lrs 2.5)."""
TRUE_MARGIN_M = 0.15
"""Returns scatter about the faces of boxes by the sensor's noise."""


def without_ego_body(
    cloud: LidarCloud,
    ego_from_sensor: Array,  # [4, 4]
) -> LidarCloud:
    """The returns that are not of the truck itself, which drives along and supervises nothing (lrs 2.3)."""
    in_ego = cloud.points[:, :3] @ ego_from_sensor[:3, :3].T + ego_from_sensor[:3, 3]
    others = ((in_ego < EGO_BODY_M[0]) | (in_ego > EGO_BODY_M[1])).any(1)
    return LidarCloud(cloud.points[others], cloud.times_us[others])


def lidar_rays(
    tensors: dict[str, torch.Tensor],  # of `lidar_tensors`, with origins
    step: int,
) -> RayBundle:
    """The returns of a batch of one as rays; one that ended where it began has no direction and is left out."""
    points, origins = tensors["lidar_points"], tensors["lidar_origins"]
    away = points[:, :3] - origins
    ranges = away.norm(dim=1)
    kept = ranges > 0
    points, origins, away, ranges = points[kept], origins[kept], away[kept], ranges[kept]
    return RayBundle(
        origins=origins,
        directions=away / ranges[:, None],
        ranges=ranges,
        times_s=-points[:, 4],
        speeds=torch.full_like(ranges, torch.nan),
        steps=torch.full((len(ranges),), step),
        batch=torch.zeros(len(ranges), dtype=torch.int64),
    )


def radar_speeds(
    rays: RayBundle,
    radar_points: Array,  # [P, 7] in the order of RADAR_POINT_FIELDS, same frame, moved by nothing of their own
) -> Array:  # [R] m/s, NaN where no return is near
    """Along each ray the velocity of the radar return nearest to its end in xy, within RADAR_RADIUS_M and _WINDOW_S.

    NaN too for what lies below RADAR_LEAST_HEIGHT_M.
    """
    speeds, ends = np.full(len(rays), np.nan), rays.points.double().numpy()
    sound = np.hypot(radar_points[:, 4], radar_points[:, 5]) <= MAX_RADIAL_MPS
    radar_points = radar_points[sound]
    high = np.flatnonzero(ends[:, 2] >= RADAR_LEAST_HEIGHT_M)
    ray, point, squared = neighbours_within(ends[high, :2], radar_points[:, :2], RADAR_RADIUS_M)
    ray = high[ray]
    # `dt` is the key frame's time less the point's, a ray's time that of its return less the key frame's.
    timely = np.abs(rays.times_s.double().numpy()[ray] + radar_points[point, 6]) <= RADAR_WINDOW_S
    ray, point, squared = ray[timely], point[timely], squared[timely]
    order = np.lexsort((squared, ray))
    ray, first = np.unique(ray[order], return_index=True)
    nearest = radar_points[point[order][first]]
    speeds[ray] = (nearest[:, 4:6] * rays.directions.double().numpy()[ray, :2]).sum(1)
    return speeds
