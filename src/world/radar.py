"""Returns of the six 4D radars: objects, static clutter, multipath ghosts and false alarms.

Mean number of returns of a target per sweep: M * S / (1 + S) with S proportional to RCS * gain / R^4, so it falls with
R^4 where the signal is weak and saturates at M close by. All six radars of one 20 Hz tick are drawn together.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from src.geometry.transforms import yaw_of
from src.world.rig import RADAR_AZIMUTH_RAD, RADAR_ELEVATION_RAD, Mount
from src.world.scenery import Scenery
from src.world.simulate import Scene
from src.world.world_config import WorldConfig

Array = np.ndarray

MAX_POINTS = 800
REACH_M = 200.0
REFERENCE_RCS_DB = 10.0
REFERENCE_RANGE_M = 135.0
"""A 10 dB target in the beam's axis gives half of its near returns here."""
OBJECT_SHARE_DB, CLUTTER_SHARE_DB = 8.0, 9.0
"""One return carries this much less than the whole target; fitted to the RCS of the one real sweep."""
THROUGH_OCCLUDER = 0.25
"""Share of returns that arrive past a vehicle in the way, mostly under it."""
SHADOW_BINS = 240


class _Returns(NamedTuple):
    """Flat list of candidate returns; every field has one entry per candidate."""

    radar: Array  # which of the six
    point: Array  # [K, 3] m, ego frame of that radar's firing
    speed: Array  # [K, 3] m/s over ground, in ego axes
    rcs_db: Array


def _joined(parts: list[_Returns]) -> _Returns:
    return _Returns(*map(np.concatenate, zip(*parts, strict=True)))


class Radars:
    """The radars of one scene; `sweep` is what they return, the other methods are its steps."""

    def __init__(
        self, config: WorldConfig, scene: Scene, scenery: Scenery, mounts: list[Mount], rng: np.random.Generator
    ) -> None:
        self.config, self.scene, self.scenery, self.rng = config, scene, scenery, rng
        self.sensor_from_ego = np.stack([m.rotation.T for m in mounts])
        self.places = np.stack([m.translation for m in mounts])  # [R, 3] m
        self.boresight = np.array([yaw_of(m.rotation) for m in mounts])  # [R] rad
        self.floor = np.array([actor.kind.floor_m for actor in scene.actors])

    def sweep(self, times_s: list[float]) -> list[Array]:
        """One sweep per radar: float32 [n, 7] with x, y, z, vrel_x, vrel_y, vrel_z, rcs in the sensor frame, n <= 800.

        vrel is relative to the moving sensor, along the line of sight, positive when the range grows.
        """
        rotation, origin = self.scene.ego.poses(np.array(times_s))
        speed, turning = self.scene.ego.rates(np.array(times_s))
        objects = self._objects(times_s, rotation, origin)
        real = _joined([objects, self._clutter(times_s[0], rotation, origin)])
        found = _joined([real, *self._ghosts(real)])
        sensor_speed = speed + np.cross(turning, self.places)
        relative = found.point - self.places[found.radar]
        distance = np.linalg.norm(relative, axis=1)
        sight = relative / np.maximum(distance, 1e-6)[:, None]
        doppler = np.einsum("ki,ki->k", found.speed - sensor_speed[found.radar], sight)
        beam = np.einsum("kij,kj->ki", self.sensor_from_ego[found.radar], relative)
        return self._measure(found, beam, distance, doppler)

    def _objects(self, times_s: list[float], rotation: Array, origin: Array) -> _Returns:
        """Returns from the faces of actors that each radar can see."""
        states = [self.scene.tracks.state(t) for t in times_s]
        rng, sizes = self.rng, self.scene.sizes
        kinds = [actor.kind for actor in self.scene.actors]
        rcs, rich, micro = (
            np.array([getattr(k, name) for k in kinds]) for name in ("rcs_db", "returns", "micro_doppler_mps")
        )
        ground = np.stack([s[0] for s in states])  # [R, N, 3] local
        centre = np.einsum("rni,rij->rnj", ground - origin[:, None], rotation)  # ego
        velocity = np.einsum("rni,rij->rnj", np.stack([s[1] for s in states]), rotation)
        yaw = np.stack([s[2] for s in states]) - yaw_of(rotation)[:, None]
        ray = centre - self.places[:, None]
        distance = np.hypot(ray[..., 0], ray[..., 1])
        azimuth = _wrap(np.arctan2(ray[..., 1], ray[..., 0]) - self.boresight[:, None])
        aspect = _wrap(np.arctan2(-ray[..., 1], -ray[..., 0]) - yaw)  # where the radar stands, in the object's axes
        width = np.abs(np.sin(aspect)) * sizes[:, 0] + np.abs(np.cos(aspect)) * sizes[:, 1]
        flash = 0.35 + 1.3 * np.cos(2 * aspect) ** 2
        most = self.config.returns_density * (rich + 0.55 * width)
        signal = flash * _strength(rcs, distance, azimuth)
        in_view = (
            (np.abs(azimuth) < RADAR_AZIMUTH_RAD + width / np.maximum(distance, 1.0))
            & (distance < REACH_M)
            & (distance > 1.0)
        )
        count = rng.poisson(np.where(in_view, most * signal / (1 + signal), 0.0))
        radar, actor = np.nonzero(count)
        repeats = count[radar, actor]
        radar, actor = np.repeat(radar, repeats), np.repeat(actor, repeats)
        local = _on_faces(aspect[radar, actor], sizes[actor], rng)
        cos, sin = np.cos(yaw[radar, actor]), np.sin(yaw[radar, actor])
        x, y = cos * local[:, 0] - sin * local[:, 1], sin * local[:, 0] + cos * local[:, 1]
        point = centre[radar, actor] + np.stack([x, y, local[:, 2] + self.floor[actor]], 1)
        shadows = _shadow_map(centre, yaw, sizes, self.floor, self.places)
        kept = self._arrives(radar, point - self.places[radar], shadows)
        radar, actor, point = radar[kept], actor[kept], point[kept]
        speed = velocity[radar, actor] + micro[actor, None] * rng.standard_normal((len(actor), 3))
        share = rcs[actor] + 10 * np.log10(flash[radar, actor]) - OBJECT_SHARE_DB + self._fading_db(len(actor))
        return _Returns(radar, point, speed, share)

    def _arrives(self, radar: Array, ray: Array, shadows: Array) -> Array:
        """Which returns come back: those not behind something large, and some of the others."""
        azimuth = np.arctan2(ray[:, 1], ray[:, 0])
        column = np.clip(((azimuth + np.pi) / (2 * np.pi) * SHADOW_BINS).astype(np.int64), 0, SHADOW_BINS - 1)
        hidden = np.hypot(ray[:, 0], ray[:, 1]) > shadows[radar, column] + 0.5
        return ~hidden | (self.rng.random(len(hidden)) < THROUGH_OCCLUDER)

    def _fading_db(self, number: int) -> Array:
        return 10 * np.log10(self.rng.exponential(1.0, number) + 0.05)

    def _clutter(self, time_s: float, rotation: Array, origin: Array) -> _Returns:
        """Returns from rails, vegetation and frames, and from the road surface close by. All of them stand still."""
        rng, ego_s = self.rng, float(self.scene.ego.tracks.road_state(time_s)[0][0])
        near = np.abs(self.scenery.clutter_s - ego_s) < REACH_M + 20
        points, rcs = self.scenery.clutter[near], self.scenery.clutter_rcs_db[near]
        seen = np.einsum("rpi,rij->rpj", points[None] - origin[:, None], rotation)
        ray = seen - self.places[:, None]
        distance = np.linalg.norm(ray, axis=-1)
        azimuth = _wrap(np.arctan2(ray[..., 1], ray[..., 0]) - self.boresight[:, None])
        signal = _strength(rcs, distance, azimuth)
        mean = 0.4 * self.config.returns_density * signal / (1 + signal)
        in_view = (np.abs(azimuth) < RADAR_AZIMUTH_RAD) & (distance < REACH_M) & (distance > 3.0)
        count = rng.poisson(np.where(in_view, mean, 0.0))
        radar, index = np.nonzero(count)
        radar, index = np.repeat(radar, count[radar, index]), np.repeat(index, count[radar, index])
        ground, _, heading = self.scene.tracks.state(time_s)
        centre, yaw = (ground - origin[0]) @ rotation[0], heading - yaw_of(rotation[0])
        middle = self.places.mean(0, keepdims=True)
        shadows = _shadow_map(centre[None], yaw[None], self.scene.sizes, self.floor, middle)
        kept = self._arrives(np.zeros_like(radar), ray[radar, index], shadows)
        radar, index = radar[kept], index[kept]
        fading = self._fading_db(len(radar))
        number = len(self.places)
        tarmac = rng.poisson(6.0 * self.config.returns_density * self.config.clutter_density, number)
        which = np.repeat(np.arange(number), tarmac)
        angle = self.boresight[which] + np.clip(rng.normal(0, 0.5, len(which)), -1.0, 1.0)
        span = 9.0 + rng.gamma(1.6, 10.0, len(which))
        surface = np.stack([span * np.cos(angle), span * np.sin(angle), np.full(len(which), -1.95)], 1)
        point = np.concatenate([seen[radar, index], self.places[which] + surface])
        strength = np.concatenate([rcs[index] + fading - CLUTTER_SHARE_DB, rng.normal(-15, 3, len(which))])
        return _Returns(np.concatenate([radar, which]), point, np.zeros_like(point), strength)

    def _ghosts(self, found: _Returns) -> tuple[_Returns, _Returns]:
        """Multipath copies (farther away, weaker, nearly the same Doppler) and returns from nowhere."""
        rng = self.rng
        picked = np.flatnonzero(rng.random(len(found.radar)) < self.config.ghost_fraction)
        longer = rng.uniform(1.05, 1.5, (len(picked), 1))
        bent = rng.normal(0, 0.05, len(picked))
        copy = found.point[picked] * longer
        copy = np.stack([copy[:, 0] - bent * copy[:, 1], copy[:, 1] + bent * copy[:, 0], copy[:, 2]], 1)
        alarms = rng.poisson(self.config.false_alarms_per_sweep, 6)
        which = np.repeat(np.arange(6), alarms)
        n = len(which)
        angle, span = rng.uniform(-np.pi, np.pi, n), rng.uniform(8, 170, n)
        nowhere = np.stack([span * np.cos(angle), span * np.sin(angle), rng.normal(1, 2, n)], 1)
        ghosts = _Returns(found.radar[picked], copy, found.speed[picked], found.rcs_db[picked] - 6.0)
        speed = rng.normal(0, 8, (n, 3)) * (rng.random((n, 1)) < 0.5)
        return ghosts, _Returns(which, nowhere, speed, rng.normal(-14, 4, n))

    def _measure(self, found: _Returns, beam: Array, distance: Array, doppler: Array) -> list[Array]:
        """Add measurement noise in range, angles and Doppler, cut to the field of view and sort into sweeps."""
        rng, n = self.rng, len(distance)
        azimuth = np.arctan2(beam[:, 1], beam[:, 0])
        elevation = np.arcsin(np.clip(beam[:, 2] / np.maximum(distance, 1e-6), -1, 1))
        in_view = np.abs(elevation) < RADAR_ELEVATION_RAD
        outlier = np.where(rng.random(n) < 0.08, 4.0, 1.0)  # the real sweep has such tails in Doppler and in elevation
        distance = distance + self.config.range_noise_m * rng.standard_normal(n)
        blur = np.radians(self.config.azimuth_noise_deg) / np.maximum(np.cos(azimuth), 0.3)
        azimuth = azimuth + blur * rng.standard_normal(n)
        elevation = elevation + np.radians(self.config.elevation_noise_deg) * outlier[::-1] * rng.standard_normal(n)
        doppler = doppler + self.config.doppler_noise_mps * outlier * rng.standard_normal(n)
        threshold = -20.0 + np.maximum(0.0, 40 * np.log10(np.maximum(distance, 1.0) / 75.0))
        rcs = np.where(found.rcs_db < threshold, threshold + rng.exponential(2.0, n), found.rcs_db)
        in_view &= (
            (np.abs(azimuth) < RADAR_AZIMUTH_RAD)
            & (np.abs(elevation) < RADAR_ELEVATION_RAD)
            & (distance > 2.0)
            & (distance < REACH_M)
        )
        flat = np.cos(elevation)
        sight = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], 1)
        table = np.concatenate(
            [distance[:, None] * sight, doppler[:, None] * sight, np.round(np.clip(rcs, -20, 66))[:, None]], 1
        )
        sweeps = []
        for number in range(len(self.places)):
            rows = np.flatnonzero(in_view & (found.radar == number))
            rows = rng.permutation(rows)[:MAX_POINTS]
            sweeps.append(table[rows].astype(np.float32))
        return sweeps


def _strength(rcs_db: Array, distance: Array, azimuth: Array) -> Array:
    """Signal over threshold S; the two-way beam falls off towards the edge of the field of view."""
    gain = np.cos(np.clip(azimuth, -1.5, 1.5)) ** 3
    return 10 ** (0.1 * (rcs_db - REFERENCE_RCS_DB)) * (REFERENCE_RANGE_M / np.maximum(distance, 1.0)) ** 4 * gain


def _on_faces(aspect: Array, size: Array, rng: np.random.Generator) -> Array:
    """Points [K, 3] on the one or two upright faces that face the radar, in object axes above the underside."""
    k = len(aspect)
    half = 0.5 * size[:, :2]
    along_end = np.abs(np.cos(aspect)) * size[:, 1]
    along_side = np.abs(np.sin(aspect)) * size[:, 0]
    on_end = rng.random(k) * (along_end + along_side) < along_end
    spread = rng.uniform(-1, 1, k)
    spread = np.where(
        rng.random(k) < 0.3, np.sign(spread) * np.abs(spread) ** 0.3, spread
    )  # corners and wheels reflect best
    depth = np.minimum(rng.exponential(0.12, k), 0.4)
    x = np.where(on_end, np.sign(np.cos(aspect)) * (half[:, 0] - np.minimum(depth, half[:, 0])), spread * half[:, 0])
    y = np.where(on_end, spread * half[:, 1], np.sign(np.sin(aspect)) * (half[:, 1] - np.minimum(depth, half[:, 1])))
    below = rng.random(k) < 0.12  # through the gap under the body
    x = np.where(below, rng.uniform(-1, 1, k) * half[:, 0], x)
    y = np.where(below, rng.uniform(-1, 1, k) * half[:, 1], y)
    return np.stack([x, y, size[:, 2] * rng.uniform(0.1, 0.8, k)], 1)


def _shadow_map(centre: Array, yaw: Array, sizes: Array, floor: Array, places: Array) -> Array:
    """Range behind which something large hides what follows, per radar and ego azimuth, [R, SHADOW_BINS] m."""
    blocks = (sizes[:, 2] > 1.2) & (sizes[:, :2].max(1) > 1.6) & (floor == 0)
    centre, yaw, sizes = centre[:, blocks], yaw[:, blocks], sizes[blocks]
    signs = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * 0.5
    offsets = signs[None] * sizes[:, None, :2]
    cos, sin = np.cos(yaw)[..., None], np.sin(yaw)[..., None]
    x = centre[..., 0, None] + cos * offsets[..., 0] - sin * offsets[..., 1] - places[:, 0, None, None]
    y = centre[..., 1, None] + sin * offsets[..., 0] + cos * offsets[..., 1] - places[:, 1, None, None]
    far = np.hypot(x, y).max(-1)
    middle = np.arctan2(y.mean(-1), x.mean(-1))
    reach = np.abs(_wrap(np.arctan2(y, x) - middle[..., None])).max(-1)
    bins = (np.arange(SHADOW_BINS) + 0.5) * 2 * np.pi / SHADOW_BINS - np.pi
    covers = np.abs(_wrap(bins - middle[..., None])) < reach[..., None]
    return np.where(covers, far[..., None], np.inf).min(1, initial=np.inf)


def _wrap(angle: Array) -> Array:
    """The same angle in -pi..pi; cheaper than a modulo."""
    return angle - 2 * np.pi * np.rint(angle * (0.5 / np.pi))
