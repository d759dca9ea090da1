"""Ray-cast lidars: the same boxes and ground that the other sensors see, with a time stamp per point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from src.world.pcd_writer import LIDAR_TYPE
from src.world.rig import CAB_M, LONG_BEAMS, LONG_LIDARS, SHORT_BEAMS, Mount
from src.world.road import Road
from src.world.simulate import Scene
from src.world.world_config import WorldConfig

Array = np.ndarray

SCAN_S = 0.1
RANGE_NOISE_M = 0.02
REFLECTIVITY = {"ground": 0.1, "slat": 0.2}
"""Of an actor it follows from its colour."""
DETECTABLE = -np.log(0.1) / 0.1
"""Echo over reflectivity at the reach: a surface of 0.1 that faces the sensor is seen with a chance of 0.9."""
NEWTON_STEPS = 8


@dataclass(kw_only=True)
class Blocks:
    """N upright cuboids that move straight while a scan lasts, in local coordinates at its middle."""

    middles: Array  # [N, 3] m
    velocities: Array  # [N, 3] m/s
    sizes: Array  # [N, 3] m
    yaws: Array  # [N] rad
    reflectivity: Array  # [N] 0..1

    def within(self, place: Array, reach_m: float) -> Blocks:
        """Those of which a part lies nearer to a place [3] than that."""
        distance = np.hypot(*(self.middles - place)[:, :2].T) - 0.5 * np.hypot(*self.sizes[:, :2].T)
        near = distance < reach_m + 0.5 * SCAN_S * np.linalg.norm(self.velocities, axis=1)
        return Blocks(**{name: column[near] for name, column in vars(self).items()})


def scan_lidars(
    config: WorldConfig, scene: Scene, mounts: list[Mount], time_s: float, stamp_us: int, rng: np.random.Generator
) -> dict[str, Array]:
    """One cloud of LIDAR_TYPE per lidar in its sensor frame, not compensated for what moves during the scan.

    Rays meet the boxes of the actors, the slats on the median and the road's surface, each at the ray's own time;
    `time_s` and `stamp_us` are those of the scan's middle. The chance of an echo falls with reflectivity, slant and the
    square of the range.
    """
    ego_s = float(scene.ego.tracks.road_state(time_s)[0][0])
    blocks = scene_blocks(scene, time_s, ego_s)
    clouds = {}
    for mount in mounts:
        beams = LONG_BEAMS if mount.channel in LONG_LIDARS else SHORT_BEAMS
        azimuths = np.arange(-beams.half_width_rad, beams.half_width_rad, np.radians(config.lidar_step_deg))
        after_s = azimuths / (2 * beams.half_width_rad) * SCAN_S
        a, e = azimuths[:, None], beams.elevations_rad
        rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e) + 0 * a], -1)  # [A, E, 3]
        rotations, translations = scene.ego.poses(time_s + after_s)
        origins = rotations @ mount.translation + translations
        directions = np.einsum("aij,aej->aei", rotations @ mount.rotation, rays)
        near = blocks.within(origins.mean(0), beams.reach_m)
        ranges, echoes, bright = cast_rays(origins, directions, after_s, near, scene.road, ego_s, beams.reach_m)
        seen = rng.random(ranges.shape) < detection_chance(echoes, ranges, beams.reach_m)
        seen &= ~_behind_cab(mount, rays)
        of_column, _ = np.nonzero(seen)
        reach = ranges[seen] + RANGE_NOISE_M * rng.standard_normal(len(of_column))
        cloud = np.zeros(len(of_column), dtype=LIDAR_TYPE)
        for axis, name in enumerate(("x", "y", "z")):
            cloud[name] = rays[seen][:, axis] * reach
        cloud["intensity"] = np.clip(255 * bright[seen] + rng.normal(0, 4, len(of_column)), 0, 255)
        cloud["timestamp"] = stamp_us + np.round(1e6 * after_s[of_column]).astype(np.int64)
        clouds[mount.channel] = cloud
    return clouds


def detection_chance(echoes: Array, ranges: Array, reach_m: float) -> Array:
    """Of an echo, by its strength and distance; none beyond the reach, where a reflectivity of 0.1 has 0.9."""
    return np.where(ranges < reach_m, 1.0 - np.exp(-DETECTABLE * echoes * (reach_m / ranges) ** 2), 0.0)


def scene_blocks(scene: Scene, time_s: float, ego_s: float) -> Blocks:
    """What stands and moves on the road around a place along it."""
    middles, velocities, yaws = scene.boxes(time_s)
    slats, slat_sizes, slat_yaws = scene.road.slats(ego_s - LONG_BEAMS.reach_m, ego_s + LONG_BEAMS.reach_m)
    paint = np.array([np.mean(actor.colour) for actor in scene.actors])
    return Blocks(
        middles=np.concatenate([middles, slats]),
        velocities=np.concatenate([velocities, np.zeros_like(slats)]),
        sizes=np.concatenate([scene.sizes, slat_sizes]),
        yaws=np.concatenate([yaws, slat_yaws]),
        reflectivity=np.concatenate([0.1 + 0.5 * paint / 255, np.full(len(slats), REFLECTIVITY["slat"])]),
    )


def cast_rays(
    origins: Array,  # [A, 3] m, local coordinates
    directions: Array,  # [A, E, 3] unit length
    after_s: Array,  # [A] the rays' times after that of the blocks
    blocks: Blocks,
    road: Road,
    guess_s: float,  # where along the road the sensor is
    reach_m: float,
) -> tuple[Array, Array, Array]:  # [A, E] each
    """Exact distance to the nearest block or to the ground (inf for none), what the surface there sends back of the
    light (its reflectivity times the cosine of the slant) and its reflectivity.
    """
    ranges, slant = _ground_hits(origins, directions, road, guess_s, reach_m)
    bright = np.full(ranges.shape, REFLECTIVITY["ground"])
    columns, owners = np.nonzero(_facing(origins, directions, after_s, blocks))
    if len(columns):
        yaw = blocks.yaws[owners]
        cos, sin, zero = np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))
        turn = np.stack([np.stack([cos, sin, zero], 1), np.stack([-sin, cos, zero], 1), [[0, 0, 1]] + zero[:, None]], 1)
        moved = blocks.middles[owners] + after_s[columns, None] * blocks.velocities[owners]
        start = np.einsum("pij,pj->pi", turn, origins[columns] - moved)[:, None]  # [P, 1, 3]
        heading = np.einsum("pij,pej->pei", turn, directions[columns])
        heading = np.where(np.abs(heading) < 1e-12, 1e-12, heading)
        half = 0.5 * blocks.sizes[owners][:, None]
        one, two = (-half - start) / heading, (half - start) / heading
        near = np.minimum(one, two)
        face = near.argmax(-1)
        enter, leave = near.max(-1), np.maximum(one, two).min(-1)
        enter[(enter >= leave) | (enter <= 0)] = np.inf
        first = np.flatnonzero(np.diff(columns, prepend=-1))
        ranges[columns[first]] = np.minimum(ranges[columns[first]], np.minimum.reduceat(enter, first))
        pair, row = np.nonzero((enter == ranges[columns]) & np.isfinite(enter))
        hit = columns[pair], row
        slant[hit] = np.abs(heading[pair, row, face[pair, row]])
        bright[hit] = blocks.reflectivity[owners[pair]]
    return ranges, slant * bright, bright


def _facing(origins: Array, directions: Array, after_s: Array, blocks: Blocks) -> Array:  # [A, N] bool
    """Which blocks the rays of a column may meet, by their bearings."""
    bearing = np.arctan2(directions[..., 1], directions[..., 0])
    middle = np.arctan2(*directions.sum(1)[:, 1::-1].T)
    half = np.abs(_wrapped(bearing - middle[:, None])).max(1)
    offset = blocks.middles + after_s[:, None, None] * blocks.velocities - origins[:, None]  # [A, N, 3]
    distance = np.hypot(offset[..., 0], offset[..., 1])
    around = 0.5 * np.hypot(*blocks.sizes[:, :2].T)
    spread = np.where(distance > around, np.arcsin(np.minimum(1.0, around / np.maximum(distance, 1e-9))), np.pi)
    away = np.abs(_wrapped(np.arctan2(offset[..., 1], offset[..., 0]) - middle[:, None]))
    return away <= spread + half[:, None]


def _wrapped(angle: Array) -> Array:
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _ground_hits(
    origins: Array, directions: Array, road: Road, guess_s: float, reach_m: float
) -> tuple[Array, Array]:  # [A, E] each
    """Distance to the road's surface (inf where there is none within the reach) and the cosine of the slant.

    Newton's method from the sensor on: slopes change so slowly that it meets the first crossing.
    """
    ranges, slant = np.full(directions.shape[:2], np.inf), np.zeros(directions.shape[:2])
    sensor_s = road.along(origins[:, :2], np.full(len(origins), guess_s))
    heading, slope = road.heading_at(sensor_s), road.slope_at(sensor_s)
    uphill = np.stack([slope * np.cos(heading), slope * np.sin(heading), -np.ones_like(slope)], 1)
    sinking = np.einsum("aej,aj->ae", directions, uphill)  # of a ray above the ground, per metre
    height = origins[:, 2] - road.height_at(sensor_s)
    down = np.nonzero(sinking * 1.5 * reach_m > height[:, None])
    ray, origin = directions[down], origins[down[0]]
    distance, s = np.zeros(len(ray)), sensor_s[down[0]]
    for _ in range(NEWTON_STEPS):
        point = origin + distance[:, None] * ray
        s = road.along(point[:, :2], s, rounds=2)
        heading, slope = road.heading_at(s), road.slope_at(s)
        rise = slope * (np.cos(heading) * ray[:, 0] + np.sin(heading) * ray[:, 1])
        sinking = np.maximum(rise - ray[:, 2], 1e-4)
        distance = distance + (point[:, 2] - road.height_at(s)) / sinking
        distance = np.clip(distance, 0.0, 2 * reach_m)
    met = distance < 1.5 * reach_m
    at = down[0][met], down[1][met]
    ranges[at], slant[at] = distance[met], sinking[met] / np.sqrt(1 + slope[met] ** 2)
    return ranges, slant


def _behind_cab(mount: Mount, rays: Array) -> Array:  # [A, E] bool
    """Rays [A, E, 3] of the sensor frame that the truck's own cab stops; the sensors give no echo of it."""
    heading = rays @ mount.rotation.T
    heading = np.where(np.abs(heading) < 1e-12, 1e-12, heading)
    sides = (CAB_M[:, None, None] - mount.translation) / heading
    enter, leave = sides.min(0).max(-1), sides.max(0).min(-1)
    return (leave > 0) & (enter < leave)
