"""What belongs to no actor: ground, markings, guard rails, trees, gantry frames, and the radar clutter they cause."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from src.world.catalogue import GREENS
from src.world.mesh import Colour, Mesh, MeshMaker
from src.world.placement import Actor
from src.world.road import LANE_M, MEDIAN_HALF_M, SHOULDER_M, SIDE_ROAD_HALF_M, SLAT_M, SLAT_STEP_M, START_M, Road
from src.world.world_config import WorldConfig

Array = np.ndarray

RAIL_POINTS, VERGE_POINTS, FAR_POINTS = 0.8, 4.5, 20.0
"""Reflecting points per metre of road at a clutter_density of 1: of each rail, of both verges, of the land beyond."""
STEP_M = 8.0
BEFORE_M = 300.0
AFTER_M = 300.0
ASPHALT: Colour = (92, 93, 97)
SHOULDER: Colour = (106, 107, 109)
GRASS: Colour = (98, 124, 62)
VERGE: Colour = (116, 132, 74)
PAINT: Colour = (232, 232, 226)
RAIL: Colour = (176, 180, 184)
HEDGE: Colour = (62, 88, 46)


@dataclass(kw_only=True)
class Scenery:
    """Static surroundings in local coordinates."""

    mesh: Mesh
    layer: Array  # [Q] factor on inverse depth: markings win over the ground that they lie on
    s: Array  # [Q] m along the road, to leave out what is far away
    clutter: Array  # [P, 3] m, points that reflect radar
    clutter_rcs_db: Array  # [P]
    clutter_s: Array  # [P] m along the road
    clutter_d: Array  # [P] m to the left of its centre line
    clutter_height: Array  # [P] m above the ground


def _strips(road: Road, s: Array, d0: float, d1: float, z0: float = 0.0, z1: float = 0.0) -> Array:
    """Quads [len(s) - 1, 4, 3] between two lateral positions at their heights (m), seen from above."""
    right, left = road.place(s, np.full_like(s, d0), z0), road.place(s, np.full_like(s, d1), z1)
    return np.stack([right[:-1], right[1:], left[1:], left[:-1]], 1)


def make_scenery(
    config: WorldConfig, road: Road, actors: list[Actor], starts: Array, reach_m: float, rng: np.random.Generator
) -> Scenery:
    """Draw the surroundings; `starts` [N, 2] are the actors' road positions, for frames around gantry signs."""
    s = np.arange(-BEFORE_M, reach_m + AFTER_M, STEP_M)
    pieces: list[tuple[Array, Array, float, bool]] = []  # quads, colours, layer, open

    def ground(d0: float, d1: float, colour: Colour, layer: float, where: Array = s, mottle: float = 0.03) -> None:
        quads = _strips(road, where, d0, d1)
        shade = 1.0 + mottle * rng.standard_normal((len(quads), 1))
        pieces.append((quads, np.clip(np.array(colour) * shade, 0, 255), layer, False))

    edge, rail = road.edge_m, road.rail_m
    bands = (
        (160.0, 45.0, GRASS, 0.06),
        (45.0, rail + 1.0, GRASS, 0.05),
        (rail + 1.0, edge + SHOULDER_M, VERGE, 0.03),
        (edge + SHOULDER_M, edge, SHOULDER, 0.015),
        (edge, MEDIAN_HALF_M - 0.6, ASPHALT, 0.02),
    )
    for side in (-1, 1):
        for outer, inner, colour, mottle in bands:
            ground(*sorted((side * outer, side * inner)), colour, 1.0, mottle=mottle)
        for d in (side * (edge + 0.1), side * (MEDIAN_HALF_M - 0.1)):
            ground(d - 0.12, d + 0.12, PAINT, 1.006, mottle=0.0)
        for lane in range(1, road.lanes):
            d = side * (MEDIAN_HALF_M + lane * LANE_M)
            for first in np.arange(s[0], s[-1] - 6, 18.0):
                ground(d - 0.1, d + 0.1, PAINT, 1.006, np.array([first, first + 6.0]), mottle=0.0)
    ground(-(MEDIAN_HALF_M - 0.6), MEDIAN_HALF_M - 0.6, VERGE, 1.0)
    if road.side_road:
        centre = road.side_road_centre()
        ground(centre - SIDE_ROAD_HALF_M, centre + SIDE_ROAD_HALF_M, (104, 102, 100), 1.004)
        for first in np.arange(s[0], s[-1] - 4, 12.0):
            ground(centre - 0.07, centre + 0.07, PAINT, 1.008, np.array([first, first + 4.0]), mottle=0.0)
    if road.apron is not None:
        far, near = road.apron_band()
        lots = np.linspace(*road.apron, 12)
        ground(far - 3, near, (112, 112, 112), 1.005, lots, mottle=0.02)
        for slot in lots:
            ground(far, far + 16, PAINT, 1.009, np.array([slot - 0.08, slot + 0.08]), mottle=0.0)
    for d in (-rail, rail, -0.7, 0.7):
        pieces.append((_strips(road, s, d, d, 0.45, 0.78), np.tile(np.array(RAIL), (len(s) - 1, 1)), 1.0, True))
        posts = _boards(road, s + 2.0, d, 0.08, 0.75)
        pieces.append((posts, np.tile(np.array((120, 122, 124)), (len(posts), 1)), 1.0, True))
    if road.screen_m > 0:
        slats = _boards(road, np.arange(s[0], s[-1], SLAT_STEP_M), 0.0, 0.5 * SLAT_M, road.screen_m)
        shade = 1.0 + 0.08 * rng.standard_normal((len(slats), 1))
        pieces.append((slats, np.clip(np.array(HEDGE) * shade, 0, 255), 1.0, True))
    mesh = Mesh(
        corners=np.concatenate([p[0] for p in pieces]),
        colours=np.concatenate([p[1] for p in pieces]).astype(np.float32),
        glows=np.zeros(sum(len(p[0]) for p in pieces), dtype=bool),
        open=np.concatenate([np.full(len(p[0]), p[3]) for p in pieces]),
    )
    layer = np.concatenate([np.full(len(p[0]), p[2]) for p in pieces])
    upright, upright_points = _upright(road, actors, starts, s[0], s[-1], rng)
    whole = Mesh.join([mesh, upright])
    along, across, height, rcs = _clutter(config, road, s[0], s[-1], upright_points, rng)
    return Scenery(
        mesh=whole,
        layer=np.concatenate([layer, np.ones(len(upright))]),
        s=_along(road, whole.corners.mean(1)),
        clutter=road.place(along, across, height),
        clutter_rcs_db=rcs,
        clutter_s=along,
        clutter_d=across,
        clutter_height=height,
    )


def _along(road: Road, points: Array) -> Array:
    """Rough s of local points, good to tens of metres: that of the nearest centre-line sample of every 20th metre."""
    coarse = road.xy[::20]
    nearest = np.argmin(((points[:, None, :2] - coarse[None]) ** 2).sum(-1), 1)
    return nearest * 20.0 + START_M


def _boards(road: Road, s: Array, d: float, half_width: float, height: float) -> Array:
    """Quads [len(s), 4, 3] that stand across the road around a lateral position (m)."""
    a, b = np.full_like(s, d - half_width), np.full_like(s, d + half_width)
    return np.stack([road.place(s, a), road.place(s, b), road.place(s, b, height), road.place(s, a, height)], 1)


def _upright(
    road: Road, actors: list[Actor], starts: Array, first: float, last: float, rng: np.random.Generator
) -> tuple[Mesh, Array]:
    """Trees and gantry frames, and the points [P, 4] (s, d, height, rcs) at which they reflect radar."""
    meshes, points = [], []
    for _ in range(int((last - first) / 6.5)):
        side = int(rng.choice([-1, 1]))
        s, d = rng.uniform(first, last), side * (road.rail_m + 26 + rng.gamma(2.0, 14.0))
        if road.apron is not None and side < 0 and road.apron[0] - 15 < s < road.apron[1] + 15:
            continue
        height = rng.uniform(4, 13)
        meshes.append(_tree(height, rng).moved(road.place(np.array(s), np.array(d)), float(rng.uniform(0, 3))))
        points += [(s, d + rng.normal(0, 1), rng.uniform(0.3, 0.6 * height), rng.normal(0, 3)) for _ in range(2)]
    gantries = {round(float(p[0]), 3) for actor, p in zip(actors, starts, strict=True) if actor.name == "gantry_sign"}
    for s in sorted(gantries):
        frame = MeshMaker()
        a, b = -(road.rail_m + 0.8), 0.0
        for d in (a, b):
            frame.box(0.15, 0.5, d - 0.2, d + 0.2, 0.0, 8.2, (140, 144, 148))
        for z in (5.9, 7.7):
            frame.box(0.2, 0.45, a, b, z, z + 0.25, (150, 154, 158))
        meshes.append(frame.mesh().moved(road.place(np.array(s), np.array(0.0)), float(road.heading_at(np.array(s)))))
        points += [(s, a + t * (b - a), z, 8.0) for t in np.linspace(0, 1, 9) for z in (5.9, 7.7)]
        points += [(s, d, z, 9.0) for d in (a, b) for z in (0.6, 2.0, 4.0)]
    return Mesh.join(meshes), np.array(points).reshape(-1, 4)


def _tree(height: float, rng: np.random.Generator) -> Mesh:
    m = MeshMaker()
    green = GREENS[int(rng.integers(len(GREENS)))]
    wide, trunk = 0.28 * height, 0.25 * height
    m.box(-0.2, 0.2, -0.2, 0.2, 0.0, trunk, (92, 72, 54))
    if rng.random() < 0.4:  # conifer
        m.frustum((-wide, wide, -wide, wide), (-0.05, 0.05, -0.05, 0.05), 0.6 * trunk, height, (44, 74, 44))
        return m.mesh()
    middle = 0.55 * height
    m.frustum((-0.6 * wide, 0.6 * wide, -0.6 * wide, 0.6 * wide), (-wide, wide, -wide, wide), trunk, middle, green)
    m.frustum((-wide, wide, -wide, wide), (-0.45 * wide, 0.45 * wide, -0.45 * wide, 0.45 * wide), middle, height, green)
    return m.mesh()


def _clutter(
    config: WorldConfig, road: Road, first: float, last: float, upright: Array, rng: np.random.Generator
) -> Array:
    """Points that reflect radar without being an actor: along, across, height (m) and RCS (dB), [4, P].

    Rail posts, vegetation of the verge, and beyond it trees, fences and buildings.
    """
    rows = [upright]

    def scatter(per_m: float, across: Callable[[int], Array], height: Callable[[int], Array], rcs: float) -> None:
        n = int(per_m * (last - first) * config.clutter_density)
        columns = rng.uniform(first, last, n), across(n), height(n), rng.normal(rcs, 5, n)
        rows.append(np.stack(columns, 1))

    for d in (-road.rail_m, road.rail_m, -0.7, 0.7):
        scatter(RAIL_POINTS, lambda n, d=d: d + rng.normal(0, 0.08, n), lambda n: rng.uniform(0.2, 0.8, n), -3.0)
    edge = road.rail_m
    scatter(
        VERGE_POINTS,
        lambda n: rng.choice([-1, 1], n) * (edge + 1 + rng.gamma(1.3, 22.0, n)),
        lambda n: rng.gamma(1.5, 1.1, n),
        -2.0,
    )
    scatter(
        FAR_POINTS,
        lambda n: rng.choice([-1, 1], n) * rng.uniform(edge + 15, 190.0, n),
        lambda n: rng.gamma(1.5, 2.2, n),
        6.0,
    )
    return np.concatenate(rows).T
