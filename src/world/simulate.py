"""One scene of the world: its road, its actors and how they move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from src.world.catalogue import KINDS
from src.world.conditions import Conditions, draw_conditions
from src.world.motion import LEAD_IN_S, EgoMotion, Tracks
from src.world.placement import Actor, bystanders, make_actor
from src.world.road import Road, make_road
from src.world.traffic import STEP_S, Vehicle, simulate_traffic
from src.world.world_config import WorldConfig

Array = np.ndarray

EGO_CENTRE_M = 2.1
"""From the ego origin (under the rear axle) to the middle of the truck."""
EGO_LENGTH_M = 7.5
MIN_REACH_M = 80.0
"""Roadside objects are spread at least this far ahead, however short the scene is."""
HITCH_OVERLAP_M = {"tractor_unit": 1.9, "rigid_truck": -1.2}
"""How far a trailer reaches over its truck; negative for a drawbar."""


COMFORTABLE_MPS2 = 3.0
"""Vehicles start so far apart that braking like this avoids a collision."""
TRAILER_CHANCE = {"tractor_unit": 0.9, "rigid_truck": 0.3}


@dataclass(kw_only=True)
class Scene:
    """Everything that the sensors look at, in local coordinates (metres; the writer adds the UTM offset)."""

    conditions: Conditions
    road: Road
    actors: list[Actor]
    tracks: Tracks  # row n belongs to actors[n]
    ego: EgoMotion
    utm_offset: Array  # [3] m

    @property
    def sizes(self) -> Array:
        """[N, 3] length, width, height."""
        return np.array([actor.size for actor in self.actors])

    @property
    def floors(self) -> Array:
        """[N] height of each actor's lower edge above the ground."""
        return np.array([actor.kind.floor_m for actor in self.actors])

    def boxes(self, time_s: float) -> tuple[Array, Array, Array]:
        """Middles [N, 3], velocities [N, 3] and headings [N] of all actors at a time, local coordinates."""
        middles, velocities, headings = self.tracks.state(time_s)
        middles[:, 2] += self.floors + 0.5 * self.sizes[:, 2]
        return middles, velocities, headings


def scene_rng(config: WorldConfig, index: int, purpose: int) -> np.random.Generator:
    """A random stream of its own for each scene and purpose, so that one part's draws never move another's."""
    return np.random.default_rng([config.seed, index, purpose])


def make_scene(config: WorldConfig, index: int) -> Scene:
    """Simulate scene `index` (train scenes first). Every scene has its own road."""
    rng = scene_rng(config, index, 0)
    first_of_split = 0 if index < config.num_train_scenes else config.num_train_scenes
    conditions = draw_conditions(rng, index - first_of_split)
    road = make_road(config, rng)
    steps = int(np.ceil((config.duration_s + 2 * LEAD_IN_S) / STEP_S)) + 2
    ego_mps = rng.uniform(60, 90) / 3.6
    fleet = _draw_fleet(config, road, ego_mps, rng)
    s, s_rate, d, d_rate = simulate_traffic(fleet, road, steps, rng)
    ego_s = s[:1] - EGO_CENTRE_M
    shift = float(np.interp(LEAD_IN_S, np.arange(steps) * STEP_S, ego_s[0]))
    ego_tracks = Tracks(road, ego_s - shift, s_rate[:1], d[:1], d_rate[:1], np.zeros((1, steps)))
    actors, rows = _split_trains(fleet, s - shift, s_rate, d, d_rate, rng)
    reach = max(float(ego_tracks.s[0, -1]), MIN_REACH_M)
    time, still = np.arange(steps) * STEP_S - LEAD_IN_S, np.ones(steps)
    for one in bystanders(config, road, reach, rng):
        s_now, d_now = one.s + one.s_rate * time, one.d + one.d_rate * time
        rows.append((s_now, one.s_rate * still, d_now, one.d_rate * still, one.turn * still))
        actors.append(one.actor)
    tracks = Tracks(road, *(np.stack(column) for column in zip(*rows, strict=True)))
    offset = np.array([7.0e5, 5.3e6, 0.0]) + np.array([rng.uniform(-2e4, 2e4), rng.uniform(-2e4, 2e4), 0.0])
    return Scene(
        conditions=conditions,
        road=road,
        actors=actors,
        tracks=tracks,
        ego=EgoMotion.draw(ego_tracks, rng),
        utm_offset=np.round(offset, 3),
    )


def _draw_fleet(config: WorldConfig, road: Road, ego_mps: float, rng: np.random.Generator) -> list[Vehicle]:
    """The ego truck first, then a bus, motorcycles and a slow machine near it, then ordinary traffic in every lane."""
    slow = road.lanes - 1
    fleet = [Vehicle("ego", 1, slow, EGO_CENTRE_M - LEAD_IN_S * ego_mps, ego_mps, EGO_LENGTH_M, may_change=False)]
    bus_lane = slow if road.lanes == 2 else slow - int(rng.integers(0, 2))
    company = [
        ("bus", bus_lane, rng.uniform(1, 4), rng.choice([-55, -38, 40, 62, 85])),
        ("motorcycle", int(rng.integers(0, slow)), rng.uniform(1, 8), rng.uniform(-70, 20)),
        ("motorcycle", int(rng.integers(0, slow + 1)), rng.uniform(-1, 4), rng.choice([-30, 28, 50])),
        ("farm_tractor" if rng.random() < 0.5 else "excavator", slow, rng.uniform(-3.5, -1), rng.uniform(70, 120)),
    ]
    for side in (1, -1):  # trucks drive in convoys: most often one close ahead of the ego truck, one close behind it
        if rng.random() < 0.6:
            _add(fleet, Vehicle("lorry", 1, slow, side * rng.uniform(32, 65), ego_mps, may_change=False))
    if rng.random() < 0.12:  # one that takes its time to overtake the ego truck
        place, wanted = rng.uniform(-26, 2), ego_mps + rng.uniform(0.5, 2.0)
        _add(fleet, Vehicle("tractor_unit", 1, slow - 1, place, wanted, has_trailer=True, may_change=False))
    for kind, lane, faster, place in company:
        chosen = "bendy_bus" if kind == "bus" and rng.random() < 0.3 else kind
        if rng.random() < 0.75 * config.rare_objects:
            _add(fleet, Vehicle(chosen, 1, lane, float(place), ego_mps + faster, may_change=False))
    for direction, low, high in ((1, -460.0, 620.0), (-1, -980.0, 260.0)):
        for lane in range(road.lanes):
            busy = config.vehicles_per_lane_km * (0.8 if lane == 0 else 1.1)
            place = low + rng.uniform(0, 40)
            while busy > 0 and place < high:
                rear_seen = direction > 0 and place > 0
                kind, wanted = _draw_vehicle(road, lane, rear_seen, rng)
                has_trailer = rear_seen and rng.random() < TRAILER_CHANCE.get(kind, 0.0)
                _add(fleet, Vehicle(kind, direction, lane, place, wanted, has_trailer=has_trailer))
                place += max(rng.exponential(1000.0 / busy), 12 + 0.9 * wanted)
    return fleet


def _add(fleet: list[Vehicle], vehicle: Vehicle) -> None:
    """Put a vehicle into its lane, with its trailer's length, unless something is too close for their speeds."""
    vehicle.length_m = KINDS[vehicle.kind].size_m[0]
    if vehicle.has_trailer:
        vehicle.length_m += KINDS[_trailer_of(vehicle.kind)].size_m[0] - HITCH_OVERLAP_M[vehicle.kind]
    near = [v for v in fleet if v.direction == vehicle.direction and v.lane == vehicle.lane]
    if all(_gap(v, vehicle) > 7 + _closing(v, vehicle) ** 2 / (2 * COMFORTABLE_MPS2) for v in near):
        fleet.append(vehicle)


def _gap(one: Vehicle, other: Vehicle) -> float:
    return abs(one.along_m - other.along_m) - 0.5 * (one.length_m + other.length_m)


def _closing(one: Vehicle, other: Vehicle) -> float:
    """Speed at which the rear one of two vehicles in a lane comes nearer, 0 where it falls behind."""
    rear, front = sorted((one, other), key=lambda vehicle: vehicle.along_m)
    return max(0.0, rear.wanted_mps - front.wanted_mps)


def _trailer_of(kind: str) -> str:
    return "semi_trailer" if kind == "tractor_unit" else "drawbar_trailer"


def _draw_vehicle(road: Road, lane: int, rear_seen: bool, rng: np.random.Generator) -> tuple[str, float]:
    """Kind and wanted speed (m/s) of ordinary traffic in a lane; up to 50 m/s (180 km/h) on the left.

    An articulated lorry is one box unless its rear is seen: behind a cab nobody tells two.
    """
    from_right = road.lanes - 1 - lane
    kinds = ("car", "lorry", "tractor_unit", "rigid_truck", "van", "bus", "motorcycle")
    chances = ((0.53, 0.17, 0.05, 0.11, 0.1, 0.02, 0.02), (0.83, 0.02, 0.01, 0.03, 0.08, 0.015, 0.015),
               (0.94, 0.0, 0.0, 0.0, 0.04, 0.0, 0.02))  # fmt: skip
    kind = str(rng.choice(kinds, p=chances[min(from_right, 2)]))
    if kind == "tractor_unit" and not rear_seen:
        kind = "lorry"
    if kind in ("lorry", "tractor_unit", "rigid_truck"):
        return kind, float(np.clip(rng.normal(23.5, 1.0), 20, 27))
    if kind == "bus":
        return "bendy_bus" if rng.random() < 0.25 else "bus", float(np.clip(rng.normal(26, 1.5), 22, 29))
    mean = {0: 35.0, 1: 44.0}.get(from_right, 46.5)
    return kind, float(np.clip(rng.normal(mean, 3.2), 25, 50))


def _split_trains(
    fleet: list[Vehicle], s: Array, s_rate: Array, d: Array, d_rate: Array, rng: np.random.Generator
) -> tuple[list[Actor], list[tuple[Array, ...]]]:
    """Turn simulated vehicles into actors: a truck with a trailer becomes two that follow one another."""
    actors, rows = [], []
    for i, vehicle in enumerate(fleet[1:], start=1):
        parts = [vehicle.kind] + ([_trailer_of(vehicle.kind)] if vehicle.has_trailer else [])
        sizes = [KINDS[name].draw_size(rng) for name in parts]
        total = sum(size[0] for size in sizes) - (HITCH_OVERLAP_M[vehicle.kind] if vehicle.has_trailer else 0.0)
        for part, (name, size) in enumerate(zip(parts, sizes, strict=True)):
            offset = 0.5 * total - 0.5 * size[0] if part == 0 else 0.5 * size[0] - 0.5 * total
            late = int(round((0.5 * total - 0.5 * size[0] - offset) / max(vehicle.wanted_mps, 5.0) / STEP_S))
            sideways = np.concatenate([np.zeros(late), d_rate[i]])[: d.shape[1]]
            across = np.concatenate([np.full(late, d[i, 0]), d[i]])[: d.shape[1]]
            along_rate = s_rate[i] * vehicle.direction
            turn = np.arctan2(sideways * vehicle.direction, np.maximum(along_rate, 2.0))
            turn = turn + (np.pi if vehicle.direction < 0 else 0.0)
            rows.append((s[i] + vehicle.direction * offset, s_rate[i], across, sideways, turn))
            actors.append(make_actor(name, size, rng))
    return actors, rows
