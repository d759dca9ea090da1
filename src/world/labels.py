"""Ground truth of one scene: which actors are labelled at which key frame, and how well the sensors see them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from src.structures.taxonomy import CLASS_RANGE_M
from src.world.dataset_statistics import count_inside
from src.world.simulate import Scene
from src.world.world_config import WorldConfig

Array = np.ndarray

SMALL_RANGE_M = 130.0
"""People label small things only as far as they can tell what they are."""
LIDAR_PATCH_RAD2 = np.radians(0.2) * np.radians(0.25)
"""Solid angle of a beam; gives the medians of the real boxes by class and distance."""


@dataclass(kw_only=True)
class FrameTruth:
    """State of all N actors at one key frame, in local coordinates."""

    centres: Array  # [N, 3] m
    yaws: Array  # [N] rad
    speeds: Array  # [N] m/s
    distance_m: Array  # [N] in the plane, from the ego origin
    own_pixels: Array  # [N]
    seen_pixels: Array  # [N]
    radar_points: Array  # [N]
    lidar_points: Array  # [N]


def frame_truth(scene: Scene, time_s: float, own_pixels: Array, seen_pixels: Array) -> FrameTruth:
    """Boxes of all actors at a key frame; point counts are zero until they are filled in."""
    centres, velocity, yaw = scene.boxes(time_s)
    _, ego = scene.ego.pose(time_s)
    nothing = np.zeros(len(centres), dtype=np.int64)
    return FrameTruth(
        centres=centres,
        yaws=yaw,
        speeds=np.linalg.norm(velocity, axis=1),
        distance_m=np.hypot(*(centres - ego)[:, :2].T),
        own_pixels=own_pixels,
        seen_pixels=seen_pixels,
        radar_points=nothing,
        lidar_points=nothing.copy(),
    )


def count_points(truth: FrameTruth, sizes: Array, points: Array) -> Array:
    """How many of the points [P, 3] (local coordinates) lie in each box, borders included: [N]."""
    counts = np.zeros(len(sizes), dtype=np.int64)
    near = np.flatnonzero(truth.distance_m < 260)
    counts[near] = count_inside(truth.centres[near], 0.5 * sizes[near], truth.yaws[near], points)
    return counts


def estimate_lidar_points(truth: FrameTruth, sizes: Array, ego_xyz: Array, rng: np.random.Generator) -> Array:
    """What a lidar would return from each actor: solid angle over that of a beam, less what is hidden."""
    bearing = np.arctan2(*(truth.centres - ego_xyz)[:, 1::-1].T)
    aspect = bearing - truth.yaws
    width = np.abs(np.sin(aspect)) * sizes[:, 0] + np.abs(np.cos(aspect)) * sizes[:, 1]
    distance = np.maximum(truth.distance_m, 2.0)
    visible = np.where(truth.own_pixels >= 4, truth.seen_pixels / np.maximum(truth.own_pixels, 1), 0.7)
    mean = width * sizes[:, 2] / distance**2 / LIDAR_PATCH_RAD2 * visible
    return rng.poisson(np.minimum(mean, 1e5))


def labelled(config: WorldConfig, scene: Scene, frames: list[FrameTruth]) -> Array:
    """Which actors are labelled when, [F, N] bool: in range, between the first and last frame with a sensor on them."""
    limit = np.array([_label_range(config, actor.kind.klass) for actor in scene.actors])
    reach = np.stack([f.distance_m for f in frames]) < limit
    seen = np.stack([(f.seen_pixels + f.radar_points + f.lidar_points) > 0 for f in frames]) & reach
    begun = np.cumsum(seen, 0) > 0
    going = np.cumsum(seen[::-1], 0)[::-1] > 0
    return reach & begun & going


def _label_range(config: WorldConfig, klass: str | None) -> float:
    if klass is None:
        return 0.0
    large = CLASS_RANGE_M[klass] > 100 or klass == "traffic_sign"
    return config.annotation_range_m if large else min(config.annotation_range_m, SMALL_RANGE_M)


def visibility_level(own: int, seen: int) -> int:
    """1 to 4 for 0-40, 40-60, 60-80, 80-100 % of the pixels shown; 1 where no image shows the place."""
    return 1 + sum(seen >= bound * own for bound in (0.4, 0.6, 0.8)) if own else 1
