"""What stands or moves slowly beside the main road: roadworks, side road, parking area, animals, signs, look-alikes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from src.world.catalogue import KINDS, Kind
from src.world.mesh import Colour
from src.world.road import Road
from src.world.world_config import WorldConfig

Array = np.ndarray


@dataclass(kw_only=True)
class Actor:
    """One object of a scene; where it is stands in the row of `Tracks` with the same number."""

    name: str  # key of KINDS
    size: Array  # [3] length, width, height in m
    colour: Colour
    has_rider: bool
    parked: bool
    variant: int  # of its look: sign face, coat, cargo

    @property
    def kind(self) -> Kind:
        """The actor's kind of object."""
        return KINDS[self.name]


@dataclass(frozen=True)
class Bystander:
    """An actor with its road position at the first key frame, constant rates, and heading relative to the road."""

    actor: Actor
    s: float
    d: float
    s_rate: float = 0.0
    d_rate: float = 0.0
    turn: float = 0.0


def make_actor(
    name: str, size: Array, rng: np.random.Generator, *, has_rider: bool = True, parked: bool = False
) -> Actor:
    """An object of this size with a look of its own."""
    kind = KINDS[name]
    return Actor(
        name=name,
        size=size,
        colour=kind.colours[int(rng.integers(len(kind.colours)))],
        has_rider=has_rider,
        parked=parked,
        variant=int(rng.integers(1 << 16)),
    )


class _Maker:
    """Draws actors from one random stream."""

    def __init__(self, config: WorldConfig, rng: np.random.Generator) -> None:
        self.config, self.rng = config, rng

    def actor(self, name: str, *, has_rider: bool = True, parked: bool = False) -> Actor:
        return make_actor(name, KINDS[name].draw_size(self.rng), self.rng, has_rider=has_rider, parked=parked)

    def count(self, mean: float) -> int:
        return int(np.floor(mean * self.config.rare_objects + self.rng.random()))


def bystanders(config: WorldConfig, road: Road, reach_m: float, rng: np.random.Generator) -> Iterator[Bystander]:
    """Actors beside the road; `reach_m` is how far the ego truck will drive."""
    make = _Maker(config, rng)
    yield from _roadworks(make, road, reach_m)
    yield from _side_road(make, road, reach_m)
    yield from _apron(make, road)
    yield from _fields(make, road, reach_m)
    yield from _signs(make, road, reach_m)
    yield from _lookalikes(make, road, reach_m)


def _roadworks(make: _Maker, road: Road, reach_m: float) -> Iterator[Bystander]:
    """Cones along a shoulder, barriers, workers and a machine; on either side of the motorway."""
    rng = make.rng
    side = -1 if rng.random() < 0.92 else 1
    start = rng.uniform(15, max(20.0, reach_m - 60))
    for i in range(make.count(3)):
        yield Bystander(
            make.actor("cone"),
            start + 9.0 * i + rng.normal(0, 0.6),
            side * (road.edge_m + 0.35 + 0.12 * i),
            turn=rng.uniform(0, 3),
        )
    begin = start + 40
    for i in range(make.count(2.3)):
        across = rng.random() < 0.5
        yield Bystander(
            make.actor("barrier"),
            begin + 3.5 * i + rng.normal(0, 0.3),
            side * (road.edge_m + rng.uniform(0.8, 2.2)),
            turn=rng.normal(0, 0.12) + (0.0 if across else np.pi / 2),
        )
    if make.count(0.8):
        yield Bystander(
            make.actor("excavator", parked=True), begin + 30, side * (road.edge_m + 5.5), turn=rng.normal(0, 0.3)
        )
        for along, chance in ((21, 0.9), (39, 0.6)):  # the site's huts hide it from either side
            if rng.random() < chance:
                yield Bystander(make.actor("container", parked=True), begin + along, side * (road.edge_m + 4.2))
    for _ in range(make.count(1.1)):
        yield Bystander(
            make.actor("police_officer" if rng.random() < 0.15 else "worker"),
            begin + rng.uniform(-30, 40),
            side * (road.edge_m + rng.uniform(1.2, 5.0)),
            s_rate=rng.choice([0.0, 0.8, -0.8]),
            turn=rng.uniform(-3.1, 3.1),
        )
    for i in range(make.count(1)):
        yield Bystander(
            make.actor("temporary_sign"),
            start - 35 * (i + 1),
            side * (road.edge_m + 1.9),
            turn=np.pi if side < 0 else 0.0,
        )


def _side_road(make: _Maker, road: Road, reach_m: float) -> Iterator[Bystander]:
    """Cyclists, walkers and slow vehicles on the parallel minor road, or on a path where there is none."""
    rng = make.rng
    centre = road.side_road_centre() if road.side_road else road.edge_m + 14.0
    for _ in range(make.count(1.5)):
        way = int(rng.choice([-1, 1]))
        speed = rng.uniform(3.5, 7.5)
        yield Bystander(
            make.actor("bicycle"),
            rng.uniform(25, reach_m - 5),
            centre - way * rng.uniform(2.0, 2.8),
            s_rate=way * speed,
            turn=0.0 if way > 0 else np.pi,
        )
    for _ in range(make.count(1.0)):
        way = int(rng.choice([-1, 1]))
        standing = rng.random() < 0.3
        place, across = rng.uniform(15, reach_m), centre - rng.choice([-1, 1]) * rng.uniform(3.4, 4.4)
        if rng.random() < 0.7:  # hidden until the truck comes near
            yield Bystander(make.actor("bush", parked=True), place - 3.0, across - np.sign(centre) * 0.5)
        yield Bystander(
            make.actor("child" if rng.random() < 0.25 else "adult"),
            place,
            across,
            s_rate=0.0 if standing else way * rng.uniform(0.9, 1.8),
            turn=0.0 if way > 0 else np.pi,
        )
    if road.side_road:
        for name, speed in (
            ("motorcycle", rng.uniform(17, 24)),
            ("farm_tractor", rng.uniform(6, 11)),
            ("car", rng.uniform(18, 25)),
        ):
            if make.count(0.35):
                way = int(rng.choice([-1, 1]))
                s = rng.uniform(-30, 60) if way > 0 else rng.uniform(reach_m - 60, reach_m + 120)
                yield Bystander(
                    make.actor(name), s, centre - way * 1.5, s_rate=way * speed, turn=0.0 if way > 0 else np.pi
                )


def _apron(make: _Maker, road: Road) -> Iterator[Bystander]:
    """Parked vehicles in slots across the parking area, people and cycles between them."""
    if road.apron is None:
        return
    rng = make.rng
    (first, last), (far, near) = road.apron, road.apron_band()
    names = ["semi_trailer", "rigid_truck", "bus", "car", "excavator", "van", "container", "semi_trailer"]
    chance = [0.4, 0.3, 0.3, 0.4, 0.25, 0.2, 0.6, 0.2]
    slots = np.linspace(first + 4, last - 4, len(names))
    for slot, k in zip(slots, rng.permutation(len(names)), strict=True):
        if make.count(chance[k]):
            actor = make.actor(names[k], parked=True)
            d = far + 0.5 * actor.size[0] + rng.uniform(2.0, 8.0)
            yield Bystander(actor, slot, d, turn=float(rng.choice([-1, 1])) * np.pi / 2 + rng.normal(0, 0.04))
    if make.count(0.5):  # one that waits for its tractor beside the motorway
        yield Bystander(make.actor("semi_trailer", parked=True), rng.uniform(first + 8, last - 8), near - 2.0)
    for name, mean in (("adult", 0.6), ("motorcycle", 0.3), ("bicycle", 0.4), ("child", 0.2)):
        for _ in range(make.count(mean)):
            walks = name in ("adult", "child") and rng.random() < 0.6
            turn = rng.uniform(-3.1, 3.1)
            speed = rng.uniform(0.7, 1.5) if walks else 0.0
            yield Bystander(
                make.actor(name, has_rider=False, parked=name in ("motorcycle", "bicycle")),
                rng.uniform(first, last),
                rng.uniform(near - 13, near - 1.5),
                s_rate=speed * np.cos(turn),
                d_rate=speed * np.sin(turn),
                turn=turn,
            )


def _fields(make: _Maker, road: Road, reach_m: float) -> Iterator[Bystander]:
    """Deer and cattle beyond the rails."""
    rng = make.rng
    for name, mean in (("deer", 1.0), ("cow", 0.8)):
        for _ in range(make.count(mean)):
            side = int(rng.choice([-1, 1]))
            turn = rng.uniform(-3.1, 3.1)
            speed = float(rng.choice([0.0, 0.5, 1.1]))
            yield Bystander(
                make.actor(name),
                rng.uniform(15, reach_m + 10),
                side * (road.rail_m + rng.uniform(3, 8)),
                s_rate=speed * np.cos(turn),
                d_rate=0.3 * speed * np.sin(turn),
                turn=turn,
            )


def _signs(make: _Maker, road: Road, reach_m: float) -> Iterator[Bystander]:
    """Signs face the traffic they are for: own signs stand on the right and look back along the road."""
    rng = make.rng
    for direction in (1, -1):
        turn = np.pi if direction > 0 else 0.0
        s = rng.uniform(-180, -100)
        while s < reach_m + 230:
            name = "guide_sign" if rng.random() < 0.15 else "sign"
            beside = name == "sign" and rng.random() < 0.2  # on the median
            across = -direction * (0.3 if beside else road.rail_m + rng.uniform(1.0, 2.5))
            yield Bystander(make.actor(name), s, across, turn=turn + rng.normal(0, 0.05))
            s += rng.uniform(100, 300) if direction > 0 else rng.uniform(40, 150)
    gantry = rng.uniform(40, reach_m + 60)
    for lane in range(road.lanes):
        if rng.random() < 0.3:
            yield Bystander(make.actor("gantry_sign"), gantry, road.lane_centre(1, lane), turn=np.pi)


def _lookalikes(make: _Maker, road: Road, reach_m: float) -> Iterator[Bystander]:
    """Things that reflect like cones, barriers, signs, animals, people or parked vehicles and are not labelled."""
    rng, clutter = make.rng, make.config.clutter_density
    for name, mean, low, high in (
        ("bollard", 9, -1.0, 4.0),
        ("cabinet", 5, 0.8, 7.0),
        ("concrete_block", 5, -1.2, 6.0),
        ("hay_bale", 5, 5.0, 20.0),
        ("bush", 16, 1.5, 25.0),
        ("lamp_post", 5, 0.8, 2.0),
        ("container", 1, 14.0, 25.0),
    ):
        for _ in range(int(mean * clutter + rng.random())):
            side = int(rng.choice([-1, 1]))
            yield Bystander(
                make.actor(name, parked=True),
                rng.uniform(-160, reach_m + 180),
                side * (road.rail_m + rng.uniform(low, high)),
                turn=rng.normal(0, 0.25) + float(rng.choice([0.0, 0.0, 1.57])),
            )
