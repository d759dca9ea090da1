"""Ray-cast lidars: the same boxes and ground that the other sensors see, with a time stamp per point."""

from __future__ import annotations

import numpy as np

from src.world.camera_render import Studio
from src.world.pcd_writer import LIDAR_TYPE
from src.world.rig import Mount
from src.world.road import SLAT_M, SLAT_STEP_M, Road
from src.world.simulate import Scene
from src.world.world_config import WorldConfig

Array = np.ndarray

SCAN_S = 0.1
HALF_WIDTH_RAD = np.radians(60.0)
ELEVATIONS_RAD = np.radians(
    np.concatenate([np.linspace(-22, -4, 16), np.linspace(-3.5, 3.5, 22), np.linspace(4.5, 10, 6)])
)
REACH_M = 180.0
RANGE_NOISE_M = 0.02
SLAT_THICK_M = 0.05


def scan_lidars(
    config: WorldConfig,
    scene: Scene,
    studio: Studio,
    mounts: list[Mount],
    time_s: float,
    stamp_us: int,
    rng: np.random.Generator,
) -> dict[str, Array]:
    """One cloud of LIDAR_TYPE per lidar in its sensor frame, not compensated for what moves during the scan.

    Rays meet the boxes of the actors (their footprint over their height), the screen on the median and the road plane
    under the truck, each at the ray's own time; `time_s` and `stamp_us` are those of the scan's middle.
    """
    ground, velocity, yaw = scene.tracks.state(time_s)
    near = np.flatnonzero(np.hypot(*(ground - scene.ego.pose(time_s)[1])[:, :2].T) < REACH_M + 10)
    middles, sizes = ground[near], scene.sizes[near]
    middles[:, 2] += studio.floors[near] + 0.5 * sizes[:, 2]
    boxes = list(zip(middles, velocity[near], sizes, yaw[near], strict=True))
    boxes += _slats(scene.road, float(scene.ego.tracks.road_state(time_s)[0][0]))
    azimuths = np.arange(-HALF_WIDTH_RAD, HALF_WIDTH_RAD, np.radians(config.lidar_step_deg))
    after_s = azimuths / (2 * HALF_WIDTH_RAD) * SCAN_S
    rotations, translations = scene.ego.poses(time_s + after_s)  # [A, 3, 3], [A, 3]
    a, e = (grid.ravel() for grid in np.meshgrid(azimuths, ELEVATIONS_RAD, indexing="ij"))
    rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], 1)
    of_ray = np.repeat(np.arange(len(azimuths)), len(ELEVATIONS_RAD))
    clouds = {}
    for mount in mounts:
        local = np.einsum("rij,rj->ri", (rotations @ mount.rotation)[of_ray], rays)
        origins = (rotations @ mount.translation + translations)[of_ray]
        distance, bright = _nearest_hit(origins, local, after_s[of_ray], boxes, translations[of_ray, 2])
        chance = np.exp(-((distance / 130.0) ** 2))
        hit = np.flatnonzero((distance < REACH_M) & (rng.random(len(distance)) < chance))
        reach = distance[hit] + RANGE_NOISE_M * rng.standard_normal(len(hit))
        cloud = np.zeros(len(hit), dtype=LIDAR_TYPE)
        for axis, name in enumerate(("x", "y", "z")):
            cloud[name] = rays[hit, axis] * reach
        cloud["intensity"] = np.clip(bright[hit] + rng.normal(0, 4, len(hit)), 0, 255)
        cloud["timestamp"] = stamp_us + np.round(1e6 * after_s[of_ray[hit]]).astype(np.int64)
        clouds[mount.channel] = cloud
    return clouds


def _slats(road: Road, along_m: float) -> list[tuple[Array, Array, Array, float]]:
    """The anti-glare screen on the median around a place along the road, as boxes of `_nearest_hit`."""
    if not road.screen_m:
        return []
    s = SLAT_STEP_M * np.arange((along_m - REACH_M) // SLAT_STEP_M, (along_m + REACH_M) // SLAT_STEP_M + 1)
    middles = road.place(s, np.zeros_like(s), 0.5 * road.screen_m)
    size = np.array([SLAT_THICK_M, SLAT_M, road.screen_m])
    return [(middle, np.zeros(3), size, yaw) for middle, yaw in zip(middles, road.heading_at(s), strict=True)]


def _nearest_hit(
    origins: Array,  # [R, 3]
    rays: Array,  # [R, 3]
    after_s: Array,  # [R] since the scan's middle
    boxes: list[tuple[Array, Array, Array, float]],  # middle (m), velocity (m/s), size (m), yaw (rad) at the middle
    ground_z: Array,  # [R]
) -> tuple[Array, Array]:  # [R] each
    """Distance to the nearest box or to the ground along each ray (inf if none) and its brightness."""
    down = np.minimum(rays[:, 2], -1e-9)
    best = np.where(rays[:, 2] < -1e-3, (ground_z - origins[:, 2]) / down, np.inf)
    bright = np.full(len(rays), 18.0)
    bearing = np.arctan2(rays[:, 1], rays[:, 0])
    middle, drift = origins.mean(0), 0.5 * np.linalg.norm(np.ptp(origins, axis=0))
    for centre, velocity, size, yaw in boxes:
        offset = centre - middle
        distance = np.hypot(offset[0], offset[1])
        reach = 0.6 * np.hypot(size[0], size[1]) + drift + 0.5 * SCAN_S * np.linalg.norm(velocity)
        spread = np.arcsin(min(1.0, reach / max(distance, 0.1)))
        away = np.abs((bearing - np.arctan2(offset[1], offset[0]) + np.pi) % (2 * np.pi) - np.pi)
        some = np.flatnonzero(away <= spread)
        turn = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
        start = (origins[some] - centre - after_s[some, None] * velocity) @ turn
        heading = rays[some] @ turn
        heading = np.where(np.abs(heading) < 1e-9, 1e-9, heading)
        one, two = (-0.5 * size - start) / heading, (0.5 * size - start) / heading
        enter, leave = np.minimum(one, two).max(1), np.maximum(one, two).min(1)
        closer = (enter < leave) & (enter > 0) & (enter < best[some])
        best[some[closer]] = enter[closer]
        bright[some[closer]] = 70.0
    return best, bright
