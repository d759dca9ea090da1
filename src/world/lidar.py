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
"""Reflectivity of what is no actor; an actor's follows from its colour."""
DETECTABLE = -np.log(0.1) / 0.1
"""Echo over reflectivity at the reach: a surface of 0.1 that faces the sensor is seen with a chance of 0.9."""
NEWTON_STEPS, EXACT_M = 12, 1e-5
"""A ray has met the ground when a step is shorter; one that never does grazes it and gives no echo."""


@dataclass(kw_only=True)
class Blocks:
    """N upright cuboids that move straight while a scan lasts, in local coordinates at its middle."""

    middles: Array  # [N, 3] m
    velocities: Array  # [N, 3] m/s
    sizes: Array  # [N, 3] m
    yaws: Array  # [N] rad
    reflectivity: Array  # [N] 0..1

    def within(self, place: Array, reach_m: float) -> Blocks:
        """Blocks of which a part may lie nearer to `place` [3] than `reach_m` while the scan lasts."""
        distance = np.hypot(*(self.middles - place)[:, :2].T) - 0.5 * np.hypot(*self.sizes[:, :2].T)
        near = distance < reach_m + 0.5 * SCAN_S * np.linalg.norm(self.velocities, axis=1)
        return Blocks(**{name: column[near] for name, column in vars(self).items()})


class Lidars:
    """The lidars of one scene; `sweep` is what they return. `rng` is theirs alone: sweeps are drawn in order."""

    def __init__(self, config: WorldConfig, scene: Scene, mounts: list[Mount], rng: np.random.Generator) -> None:
        self.scene, self.rng = scene, rng
        self.fans = [_Fan.of(mount, np.radians(config.lidar_step_deg)) for mount in mounts]

    def sweep(self, time_s: float, stamp_us: int) -> dict[str, Array]:
        """One cloud of LIDAR_TYPE per lidar in its sensor frame, not compensated for what moves during the scan.

        Rays meet the boxes of the actors, the slats on the median and the road's surface, each at the ray's own time;
        `time_s` and `stamp_us` are those of the scan's middle. The chance of an echo falls with reflectivity, slant and
        the square of the range.
        """
        ego_s = float(self.scene.ego.tracks.road_state(time_s)[0][0])
        blocks = scene_blocks(self.scene, time_s, ego_s)
        return {fan.mount.channel: self._scan(fan, blocks, ego_s, time_s, stamp_us) for fan in self.fans}

    def _scan(self, fan: _Fan, blocks: Blocks, ego_s: float, time_s: float, stamp_us: int) -> Array:
        rng, mount, reach_m = self.rng, fan.mount, fan.reach_m
        rotations, translations = self.scene.ego.poses(time_s + fan.after_s)
        origins = rotations @ mount.translation + translations
        directions = fan.rays @ (rotations @ mount.rotation).transpose(0, 2, 1)
        near = blocks.within(origins.mean(0), reach_m)
        ranges, echoes, bright = cast_rays(origins, directions, fan.after_s, near, self.scene.road, ego_s, reach_m)
        drawn = rng.random((len(fan.columns), ranges.shape[1]))[fan.columns]
        seen = fan.clear & (drawn < detection_chance(echoes, ranges, reach_m))
        column, row = np.nonzero(seen)
        reach = ranges[column, row] + RANGE_NOISE_M * rng.standard_normal(len(column))
        cloud = np.zeros(len(column), dtype=LIDAR_TYPE)
        cloud["x"], cloud["y"], cloud["z"] = (fan.rays[column, row] * reach[:, None]).T
        cloud["intensity"] = np.clip(255 * bright[column, row] + rng.normal(0, 4, len(column)), 0, 255)
        cloud["timestamp"] = stamp_us + np.round(1e6 * fan.after_s[column]).astype(np.int64)
        return cloud


@dataclass(kw_only=True)
class _Fan:
    """The rays of one lidar's scan in its sensor frame, less the columns that the truck's own cab stops altogether."""

    mount: Mount
    reach_m: float
    columns: Array  # bool for each column of the scan: whether it is one of the A
    after_s: Array  # [A] from the scan's middle
    rays: Array  # [A, E, 3] unit length
    clear: Array  # [A, E] bool: not stopped by the cab

    @classmethod
    def of(cls, mount: Mount, step_rad: float) -> _Fan:
        """The rays of a mount, its columns that far apart."""
        beams = LONG_BEAMS if mount.channel in LONG_LIDARS else SHORT_BEAMS
        azimuths = np.arange(-beams.half_width_rad, beams.half_width_rad, step_rad)
        after_s = azimuths / (2 * beams.half_width_rad) * SCAN_S
        a, e = azimuths[:, None], beams.elevations_rad
        rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e) + 0 * a], -1)
        clear = ~_behind_cab(mount, rays)
        kept = clear.any(1)
        parts = {"after_s": after_s[kept], "rays": rays[kept], "clear": clear[kept]}
        return cls(mount=mount, reach_m=beams.reach_m, columns=kept, **parts)


def detection_chance(echoes: Array, ranges: Array, reach_m: float) -> Array:
    """Chance that an echo is detected, by strength and distance: 0.9 of reflectivity 0.1 at the reach, 0 beyond."""
    return np.where(ranges < reach_m, 1.0 - np.exp(-DETECTABLE * echoes * (reach_m / ranges) ** 2), 0.0)


def scene_blocks(scene: Scene, time_s: float, ego_s: float) -> Blocks:
    """What stands and moves on the road around a place along it."""
    middles, velocities, yaws = scene.boxes(time_s)
    slats, slat_sizes, slat_yaws = scene.road.slats(ego_s - LONG_BEAMS.reach_m, ego_s + LONG_BEAMS.reach_m)
    paint = np.array([actor.colour for actor in scene.actors]).mean(1)
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
    ray, distance, cosine, owner = _block_hits(origins, directions, after_s, blocks)
    np.minimum.at(ranges.reshape(-1), ray, distance)
    first = distance == ranges.flat[ray]
    slant.flat[ray[first]], bright.flat[ray[first]] = cosine[first], blocks.reflectivity[owner[first]]
    return ranges, slant * bright, bright


def _block_hits(
    origins: Array, directions: Array, after_s: Array, blocks: Blocks
) -> tuple[Array, Array, Array, Array]:  # [H] each
    """Where rays enter blocks: the ray's flat place in [A, E], the distance, the cosine of the slant and the block."""
    column, owner, pair, row = _candidates(origins, directions, after_s, blocks)
    cos, sin = np.cos(blocks.yaws[owner]), np.sin(blocks.yaws[owner])
    x, y, z = (origins[column] - blocks.middles[owner] - after_s[column, None] * blocks.velocities[owner]).T
    start = np.stack([cos * x + sin * y, cos * y - sin * x, z])[:, pair]  # [3, K], in the axes of the block
    half = 0.5 * blocks.sizes.T[:, owner[pair]]
    ray = column[pair] * directions.shape[1] + row
    x, y, z = directions.reshape(-1, 3)[ray].T
    heading = np.stack([cos[pair] * x + sin[pair] * y, cos[pair] * y - sin[pair] * x, z])
    heading[np.abs(heading) < 1e-12] = 1e-12
    one, two = (-half - start) / heading, (half - start) / heading
    near = np.minimum(one, two)
    enter, leave = near.max(0), np.maximum(one, two).min(0)
    hit = np.flatnonzero((enter < leave) & (enter > 0))
    cosine = np.abs(heading[near[:, hit].argmax(0), hit])
    return ray[hit], enter[hit], cosine, owner[pair[hit]]


def _candidates(origins: Array, directions: Array, after_s: Array, blocks: Blocks) -> tuple[Array, Array, Array, Array]:
    """Which rays meet the upright cylinders around blocks, and perhaps a few more.

    Returns the column and the block of each pair of these [P], and the pair and the row of each ray [K].
    """
    level = np.maximum(np.sqrt(directions[..., 0] ** 2 + directions[..., 1] ** 2), 1e-12)
    middle = directions.shape[1] // 2
    ahead = directions[:, middle, :2] / level[:, middle, None]
    aside = np.abs(ahead[:, :1] * directions[..., 1] - ahead[:, 1:] * directions[..., 0]) / level
    forwards = ahead[:, :1] * directions[..., 0] + ahead[:, 1:] * directions[..., 1] > 0
    lean = np.where(forwards, aside, 1.0).max(1)[:, None]  # the largest sine between a ray's bearing and the middle's
    x, y = (
        blocks.middles[:, axis] + after_s[:, None] * blocks.velocities[:, axis] - origins[:, axis, None]
        for axis in (0, 1)
    )
    around = 0.5 * np.hypot(*blocks.sizes[:, :2].T)
    distance = np.sqrt(x * x + y * y)
    room = around + lean * distance
    beside = np.abs(ahead[:, :1] * y - ahead[:, 1:] * x) <= room
    column, owner = np.nonzero(beside & (ahead[:, :1] * x + ahead[:, 1:] * y >= -room))
    distance, around = distance[column, owner], around[owner]
    nearest, farthest = np.maximum(distance - around, 1e-12), distance + around
    z = blocks.middles[owner, 2] + after_s[column] * blocks.velocities[owner, 2] - origins[column, 2]
    top, bottom = z + 0.5 * blocks.sizes[owner, 2], z - 0.5 * blocks.sizes[owner, 2]
    highest, lowest = np.maximum(top / nearest, top / farthest), np.minimum(bottom / nearest, bottom / farthest)
    inside = distance <= around
    highest[inside], lowest[inside] = np.inf, -np.inf
    rise = (directions[..., 2] / level)[column]
    pair, row = np.nonzero((rise <= highest[:, None]) & (rise >= lowest[:, None]))
    return column, owner, pair, row


def _ground_hits(
    origins: Array, directions: Array, road: Road, guess_s: float, reach_m: float
) -> tuple[Array, Array]:  # [A, E] each
    """Distance to the road's surface (inf where there is none within the reach) and the cosine of the slant.

    Newton's method in the distance and the place along the road, from the plane under the sensor on: slopes change so
    slowly that it meets the first crossing.
    """
    ranges, slant = np.full(directions.shape[:2], np.inf), np.zeros(directions.shape[:2])
    sensor_s = road.along(origins[:, :2], np.full(len(origins), guess_s), rounds=2)
    heading, slope = road.heading_at(sensor_s)[:, None], road.slope_at(sensor_s)[:, None]
    forward = np.cos(heading) * directions[..., 0] + np.sin(heading) * directions[..., 1]
    sinking = slope * forward - directions[..., 2]  # of a ray above the ground, per metre
    height = origins[:, 2] - road.height_at(sensor_s)
    ray = np.flatnonzero(sinking * 1.5 * reach_m > height[:, None])
    column = ray // directions.shape[1]
    distance = height.take(column) / sinking.take(ray)
    s = sensor_s.take(column) + distance * forward.take(ray)
    lines = np.concatenate([directions.reshape(-1, 3).take(ray, 0).T, origins.take(column, 0).T])
    for _ in range(NEWTON_STEPS):
        if not len(ray):
            break
        dx, dy, dz, x, y, z = lines
        (road_x, road_y, heading, ground, slope), gain = road.profile_at(s)
        cos, sin = np.cos(heading), np.sin(heading)
        aside_x, aside_y = x + distance * dx - road_x, y + distance * dy - road_y
        # Of s against metres at that side; infinite at the centre of a bend.
        stretch = 1.0 / np.maximum(1.0 - gain[2] * (cos * aside_y - sin * aside_x), 0.1)
        ahead, forward = cos * aside_x + sin * aside_y, cos * dx + sin * dy
        climb = gain[3] * stretch  # of the ground, per metre ahead
        rise = np.maximum(climb * forward - dz, 1e-4)
        nearer = distance + (z + distance * dz - ground - climb * ahead) / rise
        nearer = np.minimum(np.maximum(nearer, 0.0), 2 * reach_m)
        step = nearer - distance
        s = s + stretch * (ahead + step * forward)
        going = np.abs(step) > EXACT_M
        met = np.flatnonzero(~going & (nearer < 1.5 * reach_m))
        ranges.reshape(-1)[ray.take(met)] = nearer.take(met)
        cosine = np.maximum(slope * forward - dz, 1e-4) / np.sqrt(1 + slope**2)
        slant.reshape(-1)[ray.take(met)] = cosine.take(met)
        going = np.flatnonzero(going)
        ray, s, distance, lines = ray.take(going), s.take(going), nearer.take(going), lines.take(going, 1)
    return ranges, slant


def _behind_cab(mount: Mount, rays: Array) -> Array:  # [A, E] bool
    """Rays [A, E, 3] of the sensor frame that the truck's own cab stops; the sensors give no echo of it."""
    heading = rays @ mount.rotation.T
    heading = np.where(np.abs(heading) < 1e-12, 1e-12, heading)
    sides = (CAB_M[:, None, None] - mount.translation) / heading
    enter, leave = sides.min(0).max(-1), sides.max(0).min(-1)
    return (leave > 0) & (enter < leave)
