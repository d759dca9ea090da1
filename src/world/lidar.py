"""Ray-cast lidars: the same boxes and ground that the other sensors see, with a time stamp per point."""

from __future__ import annotations

import numpy as np

from src.world.camera_render import Studio
from src.world.pcd_writer import LIDAR_TYPE
from src.world.rig import Mount
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


def scan_lidars(
    config: WorldConfig,
    scene: Scene,
    studio: Studio,
    mounts: list[Mount],
    time_s: float,
    stamp_us: int,
    rng: np.random.Generator,
) -> dict[str, Array]:
    """One cloud of LIDAR_TYPE per lidar in its sensor frame, not motion compensated beyond the scan's middle.

    Rays meet the boxes of the actors (their footprint over their height) and the road plane under the truck.
    """
    rotation, translation = scene.ego.pose(time_s)
    ground, _, yaw = scene.tracks.state(time_s)
    near = np.flatnonzero(np.hypot(*(ground - translation)[:, :2].T) < REACH_M + 10)
    sizes = scene.sizes[near]
    middle = ground[near] + np.stack(
        [np.zeros(len(near)), np.zeros(len(near)), studio.floors[near] + 0.5 * sizes[:, 2]], 1
    )
    azimuths = np.arange(-HALF_WIDTH_RAD, HALF_WIDTH_RAD, np.radians(config.lidar_step_deg))
    a, e = (grid.ravel() for grid in np.meshgrid(azimuths, ELEVATIONS_RAD, indexing="ij"))
    rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], 1)
    clouds = {}
    for mount in mounts:
        origin = rotation @ mount.translation + translation
        local = rays @ (rotation @ mount.rotation).T
        distance, bright = _nearest_hit(origin, local, middle, sizes, yaw[near], float(translation[2]))
        chance = np.exp(-((distance / 130.0) ** 2))
        hit = np.flatnonzero((distance < REACH_M) & (rng.random(len(distance)) < chance))
        reach = distance[hit] + RANGE_NOISE_M * rng.standard_normal(len(hit))
        cloud = np.zeros(len(hit), dtype=LIDAR_TYPE)
        for axis, name in enumerate(("x", "y", "z")):
            cloud[name] = rays[hit, axis] * reach
        cloud["intensity"] = np.clip(bright[hit] + rng.normal(0, 4, len(hit)), 0, 255)
        phase = (a[hit] + HALF_WIDTH_RAD) / (2 * HALF_WIDTH_RAD) - 0.5
        cloud["timestamp"] = stamp_us + np.round(phase * SCAN_S * 1e6).astype(np.int64)
        clouds[mount.channel] = cloud
    return clouds


def _nearest_hit(
    origin: Array, rays: Array, centres: Array, sizes: Array, yaws: Array, ground_z: float
) -> tuple[Array, Array]:
    """Distance to the nearest box or to the ground along each ray (inf if none) and its brightness."""
    down = np.minimum(rays[:, 2], -1e-9)
    best = np.where(rays[:, 2] < -1e-3, (ground_z - origin[2]) / down, np.inf)
    bright = np.full(len(rays), 18.0)
    bearing = np.arctan2(rays[:, 1], rays[:, 0])
    for centre, size, yaw in zip(centres, sizes, yaws, strict=True):
        offset = centre - origin
        distance = np.hypot(offset[0], offset[1])
        spread = np.arcsin(min(1.0, 0.6 * np.hypot(size[0], size[1]) / max(distance, 0.1)))
        away = np.abs((bearing - np.arctan2(offset[1], offset[0]) + np.pi) % (2 * np.pi) - np.pi)
        some = np.flatnonzero(away <= spread)
        turn = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
        start, heading = -offset @ turn, rays[some] @ turn
        heading = np.where(np.abs(heading) < 1e-9, 1e-9, heading)
        one, two = (-0.5 * size - start) / heading, (0.5 * size - start) / heading
        enter, leave = np.minimum(one, two).max(1), np.maximum(one, two).min(1)
        closer = (enter < leave) & (enter > 0) & (enter < best[some])
        best[some[closer]] = enter[closer]
        bright[some[closer]] = 70.0
    return best, bright
