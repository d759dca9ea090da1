"""Returns of the six 4D radars: objects, static clutter, multipath ghosts and false alarms.

Mean number of returns of a target per sweep: M * S / (1 + S) with S proportional to RCS * gain / R^4, so it falls with
R^4 where the signal is weak and saturates at M close by. All six radars of one 20 Hz tick are drawn together.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from src.geometry.transforms import yaw_of
from src.world.rig import RADAR_AZIMUTH_RAD, RADAR_ELEVATION_RAD, Mount
from src.world.road import SLAT_M, SLAT_STEP_M
from src.world.scenery import Scenery
from src.world.simulate import Scene
from src.world.world_config import WorldConfig

Array = np.ndarray

MAX_POINTS = 800
REFERENCE_RCS_DB = 10.0
REFERENCE_RANGE_M = 135.0
"""A 10 dB target in the beam's axis gives half of its near returns here."""
OBJECT_SHARE_DB, CLUTTER_SHARE_DB = 14.0, 12.0
"""One return carries this much less than the whole target; fitted to the RCS of the one real sweep."""
CLUTTER_RETURNS = 0.5
"""Returns per sweep of a near clutter point."""
MIRRORED_DB = 6.0
"""What a guard rail swallows of a return that it mirrors."""
SHADOW_BINS = 240
TALL_M = 2.2
OVER_CARS_M = 1.3
"""The radars, two metres up, see what is higher than this past anything that is not tall."""


class _Hiding(NamedTuple):
    """What stands in the way at one tick: other vehicles, and the screen on the median."""

    shadows: Array  # [2, R, SHADOW_BINS] m, range behind which a tall object, or any, hides what follows
    own: float  # m, where the ego truck is across the road


class _Returns(NamedTuple):
    """Flat list of candidate returns; every field has one entry per candidate."""

    radar: Array  # which of the six
    point: Array  # [K, 3] m, ego frame of that radar's firing
    speed: Array  # [K, 3] m/s over ground, in ego axes
    rcs_db: Array


def _joined(parts: list[_Returns]) -> _Returns:
    return _Returns(*map(np.concatenate, zip(*parts, strict=True)))


class Radars:
    """The radars of one scene; `sweep` is what they return, the other methods are its steps.

    `mounts` are where the radars really look, `rng` is theirs alone: sweeps are drawn in the order of their times.
    """

    def __init__(
        self, config: WorldConfig, scene: Scene, scenery: Scenery, mounts: list[Mount], rng: np.random.Generator
    ) -> None:
        self.config, self.scene, self.scenery, self.rng = config, scene, scenery, rng
        self.sensor_from_ego = np.stack([m.rotation.T for m in mounts])
        self.places = np.stack([m.translation for m in mounts])  # [R, 3] m
        self.boresight = np.array([yaw_of(m.rotation) for m in mounts])  # [R] rad
        self.floor = np.array([actor.kind.floor_m for actor in scene.actors])
        self.centres = _scattering_centres(config, scene.sizes, rng)
        self.gain_db = config.gain_db * rng.standard_normal(len(scene.actors))
        self.time_s: float | None = None

    def sweep(self, times_s: list[float]) -> list[Array]:
        """One sweep per radar: float32 [n, 7] with x, y, z, vrel_x, vrel_y, vrel_z, rcs in the sensor frame, n <= 800.

        vrel is relative to the moving sensor, along the line of sight, positive when the range grows.
        """
        self._fade(times_s[0])
        rotation, origin = self.scene.ego.poses(np.array(times_s))
        speed, turning = self.scene.ego.rates(np.array(times_s))
        objects, mirrored, hiding = self._objects(times_s, rotation, origin)
        real = _joined([objects, mirrored, self._clutter(hiding, times_s[0], rotation, origin)])
        found = _joined([real, *self._ghosts(real)])
        sensor_speed = speed + np.cross(turning, self.places)
        relative = found.point - self.places[found.radar]
        distance = np.linalg.norm(relative, axis=1)
        sight = relative / np.maximum(distance, 1e-6)[:, None]
        doppler = np.einsum("ki,ki->k", found.speed - sensor_speed[found.radar], sight)
        beam = np.einsum("kij,kj->ki", self.sensor_from_ego[found.radar], relative)
        return self._measure(found, beam, distance, doppler)

    def _fade(self, time_s: float) -> None:
        """Let every actor's gain drift: a first-order autoregressive process, so that dropouts outlast a few sweeps."""
        if self.time_s is not None:
            kept = np.exp(-(time_s - self.time_s) / self.config.gain_s)
            fresh = self.config.gain_db * self.rng.standard_normal(len(self.gain_db))
            self.gain_db = kept * self.gain_db + np.sqrt(1.0 - kept**2) * fresh
        self.time_s = time_s

    def _objects(self, times_s: list[float], rotation: Array, origin: Array) -> tuple[_Returns, _Returns, _Hiding]:
        """Returns from the faces of actors that each radar can see, those that the outer rails mirror, and what the
        actors hide.
        """
        states = [self.scene.tracks.state(t) for t in times_s]
        rng, sizes = self.rng, self.scene.sizes
        kinds = [actor.kind for actor in self.scene.actors]
        rcs, rich, micro = (
            np.array([getattr(k, name) for k in kinds]) for name in ("rcs_db", "returns", "micro_doppler_mps")
        )
        rcs = rcs + self.gain_db
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
        most = self.config.returns_density * rich * (1.0 + 0.25 * width)
        signal = flash * _strength(rcs, distance, azimuth)
        in_view = (
            (np.abs(azimuth) < RADAR_AZIMUTH_RAD + width / np.maximum(distance, 1.0))
            & (distance < self.config.radar_reach_m)
            & (distance > 1.0)
        )
        count = rng.poisson(np.where(in_view, most * signal / (1 + signal), 0.0))
        radar, actor = np.nonzero(count)
        repeats = count[radar, actor]
        radar, actor = np.repeat(radar, repeats), np.repeat(actor, repeats)
        local = self._on_faces(aspect[radar, actor], actor)
        cos, sin = np.cos(yaw[radar, actor]), np.sin(yaw[radar, actor])
        x, y = cos * local[:, 0] - sin * local[:, 1], sin * local[:, 0] + cos * local[:, 1]
        offset = np.stack([x, y, local[:, 2] + self.floor[actor]], 1)
        along, _, across, _, _ = self.scene.tracks.road_state(times_s[0])
        own = float(self.scene.ego.tracks.road_state(times_s[0])[2][0])
        hiding = _Hiding(_shadow_map(centre, yaw, sizes, self.floor, self.places), own)
        point = centre[radar, actor] + offset
        kept = self._arrives(hiding, radar, point - self.places[radar], across[actor], offset[:, 2])
        radar, actor, point, offset = radar[kept], actor[kept], point[kept], offset[kept]
        speed = velocity[radar, actor] + micro[actor, None] * rng.standard_normal((len(actor), 3))
        share = rcs[actor] + 10 * np.log10(flash[radar, actor]) - OBJECT_SHARE_DB + self._fading_db(len(actor))
        returns = _Returns(radar, point, speed, share)
        left = self.scene.road.heading_at(along) + 0.5 * np.pi - yaw_of(rotation[0])
        normal = np.stack([np.cos(left), np.sin(left), np.zeros_like(left)], 1)[actor]
        return returns, self._mirrored(returns, across[actor] + (offset * normal).sum(1), normal), hiding

    def _mirrored(self, found: _Returns, across: Array, normal: Array) -> _Returns:
        """Copies of returns of moving actors behind the outer rail of their side, with the mirrored velocity.

        `across` [K] is where a return lies across the road, `normal` [K, 3] the way to the left of the road there.
        """
        moving = np.linalg.norm(found.speed, axis=1) > 5.0
        picked = np.flatnonzero(moving & (self.rng.random(len(moving)) < self.config.mirror_fraction))
        rail = np.sign(across[picked]) * self.scene.road.rail_m
        normal, speed = normal[picked], found.speed[picked]
        point = found.point[picked] + 2.0 * (rail - across[picked])[:, None] * normal
        speed = speed - 2.0 * (speed * normal).sum(1, keepdims=True) * normal
        return _Returns(found.radar[picked], point, speed, found.rcs_db[picked] - MIRRORED_DB)

    def _on_faces(self, aspect: Array, actor: Array) -> Array:
        """One of the fixed scattering centres on a face that is turned to the radar, for each return: [K, 3]."""
        k, size = len(aspect), self.scene.sizes[actor]
        along_end = np.abs(np.cos(aspect)) * size[:, 1]
        along_side = np.abs(np.sin(aspect)) * size[:, 0]
        on_end = self.rng.random(k) * (along_end + along_side) < along_end
        face = np.where(on_end, np.where(np.cos(aspect) > 0, 0, 1), np.where(np.sin(aspect) > 0, 2, 3))
        return self.centres[actor, face, self.rng.integers(self.config.scattering_centres, size=k)]

    def _arrives(self, hiding: _Hiding, radar: Array, ray: Array, across: Array, height: Array) -> Array:
        """Which returns come back: those with nothing in the way, and some of the others.

        `ray` [K, 3] leads from the radar; `across` [K] is where it ends across the road, `height` [K] above the ground.
        """
        distance = np.hypot(ray[:, 0], ray[:, 1])
        azimuth = np.arctan2(ray[:, 1], ray[:, 0])
        column = np.clip(((azimuth + np.pi) / (2 * np.pi) * SHADOW_BINS).astype(np.int64), 0, SHADOW_BINS - 1)
        hidden = distance > hiding.shadows[(height < OVER_CARS_M).astype(np.int64), radar, column] + 0.5
        aside = np.maximum(across - hiding.own, 1e-3)
        part = -hiding.own / aside  # of the ray where it crosses the median
        sight = self.places[radar, 2] * (1.0 - part) + height * part
        met = (across > 0.5) & (sight < self.scene.road.screen_m)
        closed = SLAT_M / SLAT_STEP_M * np.sqrt(np.maximum(distance**2 - aside**2, 0.0)) / aside
        hidden |= met & (self.rng.random(len(met)) < closed)
        return ~hidden | (self.rng.random(len(hidden)) < self.config.past_occluder)

    def _fading_db(self, number: int) -> Array:
        return 10 * np.log10(self.rng.exponential(1.0, number) + 0.05)

    def _clutter(self, hiding: _Hiding, time_s: float, rotation: Array, origin: Array) -> _Returns:
        """Returns from rails, vegetation and frames, and from the road surface close by. All of them stand still."""
        rng, ego_s = self.rng, float(self.scene.ego.tracks.road_state(time_s)[0][0])
        near = np.abs(self.scenery.clutter_s - ego_s) < self.config.radar_reach_m + 20
        points, rcs = self.scenery.clutter[near], self.scenery.clutter_rcs_db[near]
        radar, index = np.nonzero(self._ahead(points, rotation, origin))
        seen = np.einsum("ki,kij->kj", points[index] - origin[radar], rotation[radar])
        ray = seen - self.places[radar]
        distance = np.linalg.norm(ray, axis=-1)
        azimuth = _wrap(np.arctan2(ray[:, 1], ray[:, 0]) - self.boresight[radar])
        signal = _strength(rcs[index], distance, azimuth)
        mean = CLUTTER_RETURNS * signal / (1 + signal)
        in_view = (np.abs(azimuth) < RADAR_AZIMUTH_RAD) & (distance < self.config.radar_reach_m) & (distance > 3.0)
        returned = np.repeat(np.arange(len(radar)), rng.poisson(np.where(in_view, mean, 0.0)))
        radar, index, seen, ray = radar[returned], index[returned], seen[returned], ray[returned]
        across, height = self.scenery.clutter_d[near][index], self.scenery.clutter_height[near][index]
        kept = self._arrives(hiding, radar, ray, across, height)
        radar, index, seen = radar[kept], index[kept], seen[kept]
        fading = self._fading_db(len(radar))
        number = len(self.places)
        tarmac = rng.poisson(self.config.tarmac_returns * self.config.clutter_density, number)
        which = np.repeat(np.arange(number), tarmac)
        angle = self.boresight[which] + np.clip(rng.normal(0, 0.5, len(which)), -1.0, 1.0)
        span = 9.0 + rng.gamma(1.6, 10.0, len(which))
        surface = np.stack([span * np.cos(angle), span * np.sin(angle), np.full(len(which), -1.95)], 1)
        point = np.concatenate([seen, self.places[which] + surface])
        strength = np.concatenate([rcs[index] + fading - CLUTTER_SHARE_DB, rng.normal(-15, 3, len(which))])
        return _Returns(np.concatenate([radar, which]), point, np.zeros_like(point), strength)

    def _ahead(self, points: Array, rotation: Array, origin: Array) -> Array:  # [R, P] bool
        """Which points [P, 3] (local coordinates) each radar may have in view, by where they are in the plane.

        Beyond 10 m the truck's sway and slope turn the bearing of no point by as much as 5 degrees.
        """
        place = np.einsum("rij,rj->ri", rotation, self.places) + origin
        yaw = self.boresight + yaw_of(rotation)
        x, y = (points[:, axis] - place[:, axis, None] for axis in (0, 1))
        forward = np.cos(yaw)[:, None] * x + np.sin(yaw)[:, None] * y
        away = x * x + y * y
        ahead = (forward > 0) & (forward * forward > np.cos(RADAR_AZIMUTH_RAD + np.radians(5.0)) ** 2 * away)
        return (ahead | (away < 10.0**2)) & (away < (self.config.radar_reach_m + 1.0) ** 2)

    def _ghosts(self, found: _Returns) -> tuple[_Returns, _Returns]:
        """Multipath copies (farther away, weaker, nearly the same Doppler) and returns from nowhere."""
        rng = self.rng
        picked = np.flatnonzero(rng.random(len(found.radar)) < self.config.ghost_fraction)
        longer = rng.uniform(1.05, 1.5, (len(picked), 1))
        bent = rng.normal(0, 0.05, len(picked))
        copy = found.point[picked] * longer
        copy = np.stack([copy[:, 0] - bent * copy[:, 1], copy[:, 1] + bent * copy[:, 0], copy[:, 2]], 1)
        alarms = rng.poisson(self.config.false_alarms_per_sweep, len(self.places))
        which = np.repeat(np.arange(len(alarms)), alarms)
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
        folded = np.flatnonzero(rng.random(n) < self.config.aliased_fraction)
        doppler[folded] += self.config.doppler_span_mps * rng.choice([-1.0, 1.0], len(folded))
        threshold = -20.0 + np.maximum(0.0, 40 * np.log10(np.maximum(distance, 1.0) / 75.0))
        rcs = np.where(found.rcs_db < threshold, threshold + rng.exponential(2.0, n), found.rcs_db)
        in_view &= (
            (np.abs(azimuth) < RADAR_AZIMUTH_RAD)
            & (np.abs(elevation) < RADAR_ELEVATION_RAD)
            & (distance > 2.0)
            & (distance < self.config.radar_reach_m)
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


def _scattering_centres(config: WorldConfig, sizes: Array, rng: np.random.Generator) -> Array:
    """Where each actor reflects, [N, 4 faces, K, 3] m in object axes above the underside; faces: front, rear, left,
    right. The centres lie about the label's faces, not on them.
    """
    shape = (len(sizes), 4, config.scattering_centres)
    half = 0.5 * sizes[:, None, None, :2]
    spread = rng.uniform(-1, 1, shape)
    sharp = np.sign(spread) * np.abs(spread) ** 0.3
    spread = np.where(rng.random(shape) < 0.3, sharp, spread)  # corners and wheels reflect best
    depth = np.minimum(rng.exponential(0.12, shape), 0.4)[..., None]
    below = rng.random(shape) < 0.12  # through the gap under the body
    sign = np.array([1.0, -1.0, 1.0, -1.0])[None, :, None]
    end = np.array([True, True, False, False])[None, :, None]
    face = sign[..., None] * (half - np.minimum(depth, half))  # [N, 4, K, 2]: where a face of that axis lies
    x = np.where(end, face[..., 0], spread * half[..., 0])
    y = np.where(end, spread * half[..., 1], face[..., 1])
    x = np.where(below, rng.uniform(-1, 1, shape) * half[..., 0], x)
    y = np.where(below, rng.uniform(-1, 1, shape) * half[..., 1], y)
    z = sizes[:, None, None, 2] * rng.uniform(0.1, 0.8, shape)
    return np.stack([x, y, z], -1) + config.scatter_m * rng.standard_normal((*shape, 3)) * [1.0, 1.0, 0.0]


def _shadow_map(centre: Array, yaw: Array, sizes: Array, floor: Array, places: Array) -> Array:
    """Range behind which a tall object, or any large one, hides what follows, by radar and ego azimuth,
    [2, R, SHADOW_BINS] m.
    """
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
    behind = np.where(covers, far[..., None], np.inf)
    tall = sizes[:, 2] > TALL_M
    return np.stack([behind[:, tall].min(1, initial=np.inf), behind.min(1, initial=np.inf)])


def _wrap(angle: Array) -> Array:
    """The same angle in -pi..pi; cheaper than a modulo."""
    return angle - 2 * np.pi * np.rint(angle * (0.5 / np.pi))
