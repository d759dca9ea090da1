"""Riders, people, animals, signs, roadside things. Origin: middle of the underside; only poles leave the box.

l and w are half the length and width of the box, h its height, all in metres.
"""

from __future__ import annotations

import numpy as np

from src.world.mesh import Colour, MeshMaker, shade
from src.world.placement import Actor

STEEL: Colour = (90, 92, 96)
SKIN: Colour = (214, 170, 140)
POST: Colour = (150, 152, 154)


def _rider(m: MeshMaker, x: float, seat: float, top: float, width: float, coat: Colour, helmet: Colour) -> None:
    height = top - seat
    m.frustum((x - 0.3, x + 0.05, -width, width), (x - 0.12, x + 0.18, -width, width), seat, seat + 0.66 * height, coat)
    m.box(x - 0.02, x + 0.22, -0.14, 0.14, seat + 0.66 * height, top, helmet)
    for side in (-1, 1):
        m.box(x - 0.1, x + 0.25, side * width - 0.07, side * width + 0.07, seat - 0.5, seat + 0.02, (40, 44, 60))


def add_motorcycle(m: MeshMaker, a: Actor, l: float, w: float, h: float) -> None:
    for x in (-0.66 * l, 0.66 * l):
        m.wheel(x, 0.05, 0.33 * l, 1)
        m.wheel(x, -0.05, 0.33 * l, -1)
    top = 0.55 * h if a.has_rider else 0.78 * h
    m.frustum((-0.7 * l, 0.6 * l, -0.16, 0.16), (-0.85 * l, 0.45 * l, -0.2, 0.2), 0.24 * h, top, a.colour)
    m.box(0.35 * l, 0.45 * l, -w, w, 0.62 * h, 0.68 * h, STEEL)
    m.lights(0.6 * l, -0.85 * l, 0.14, 0.42 * h, 0.16)
    if a.has_rider:
        helmets: tuple[Colour, ...] = ((240, 240, 240), (200, 30, 30), (250, 200, 20))
        _rider(m, -0.12 * l, 0.5 * h, h, 0.25, (44, 46, 54), helmets[a.variant % 3])


def add_bicycle(m: MeshMaker, a: Actor, l: float, w: float, h: float) -> None:
    for x in (-0.6 * l, 0.6 * l):
        m.wheel(x, 0.0, 0.38 * l, 1, hub=(150, 170, 150))
    m.box(-0.55 * l, 0.55 * l, -0.03, 0.03, 0.42, 0.5, a.colour)
    m.frustum((-0.1, 0.02, -0.03, 0.03), (-0.3, -0.18, -0.03, 0.03), 0.3, 0.95, a.colour)
    m.box(0.5 * l, 0.58 * l, -w, w, 0.98, 1.04, STEEL)
    if a.has_rider:
        coats: tuple[Colour, ...] = ((40, 110, 200), (220, 210, 40), (200, 40, 70), (60, 150, 80))
        _rider(m, -0.1, 0.92, h, 0.2, coats[a.variant % 4], (235, 235, 235))


def add_person(m: MeshMaker, a: Actor, l: float, w: float, h: float) -> None:
    trousers: Colour = ((50, 54, 70), (80, 70, 60), (36, 36, 40))[a.variant % 3]
    for side, lean in ((-1, 0.35), (1, -0.35)):
        m.frustum(
            (lean * l - 0.09, lean * l + 0.09, side * 0.1 - 0.08, side * 0.1 + 0.08),
            (-0.09, 0.09, side * 0.1 - 0.08, side * 0.1 + 0.08),
            0.0,
            0.48 * h,
            trousers,
        )
        m.frustum(
            (-lean * l - 0.06, -lean * l + 0.06, side * 0.82 * w - 0.06, side * 0.82 * w + 0.06),
            (-0.06, 0.06, side * 0.7 * w - 0.06, side * 0.7 * w + 0.06),
            0.45 * h,
            0.8 * h,
            shade(a.colour, 0.85),
        )
    m.frustum((-0.13, 0.13, -0.6 * w, 0.6 * w), (-0.13, 0.13, -0.68 * w, 0.68 * w), 0.46 * h, 0.83 * h, a.colour)
    m.box(-0.1, 0.1, -0.1, 0.1, 0.85 * h, h, SKIN, top=(70, 50, 36))


def add_worker(m: MeshMaker, a: Actor, l: float, w: float, h: float) -> None:
    add_person(m, a, l, w, h)
    m.box(-0.14, 0.14, -0.66 * w, 0.66 * w, 0.6 * h, 0.66 * h, (240, 240, 220))
    helmet: Colour = (250, 220, 30) if a.name == "worker" else (30, 40, 90)
    m.box(-0.13, 0.13, -0.13, 0.13, 0.93 * h, h + 0.01, helmet)


def add_cone(m: MeshMaker, a: Actor, l: float, w: float, h: float) -> None:
    m.box(-l, l, -w, w, 0.0, 0.07 * h, (50, 50, 50))
    bands = ((0.07, 0.4, a.colour), (0.4, 0.65, (245, 245, 245)), (0.65, 1.0, a.colour))
    for low, high, colour in bands:
        r0, r1 = 0.72 * l * (1.05 - low), 0.72 * l * (1.05 - high)
        m.frustum((-r0, r0, -r0, r0), (-r1, r1, -r1, r1), low * h, high * h, colour)


def add_barrier(m: MeshMaker, a: Actor, l: float, w: float, h: float) -> None:
    for y in (-0.75 * w, 0.75 * w):
        m.box(-l, l, y - 0.06, y + 0.06, 0.0, 0.5 * h, STEEL)
    for z0, z1, shift in ((0.35, 0.6, 0), (0.7, 1.0, 1)):
        m.box(-0.06, 0.06, -w, w, z0 * h, z1 * h, (240, 240, 240))
        for k in range(3):
            y0 = -w + (2 * k + shift) * w / 3
            for facing in (1, -1):
                m.panel(facing * 0.075, y0, y0 + w / 3, z0 * h, z1 * h, facing, a.colour)


def add_animal(m: MeshMaker, a: Actor, l: float, w: float, h: float) -> None:
    m.box(-l, 0.55 * l, -0.85 * w, 0.85 * w, 0.42 * h, 0.8 * h, a.colour)
    for x in (-0.82 * l, 0.42 * l):
        for side in (-1, 1):
            m.box(
                x - 0.07, x + 0.07, side * 0.6 * w - 0.07, side * 0.6 * w + 0.07, 0.0, 0.42 * h, shade(a.colour, 0.75)
            )
    m.frustum(
        (0.3 * l, 0.55 * l, -0.3 * w, 0.3 * w), (0.55 * l, 0.8 * l, -0.3 * w, 0.3 * w), 0.65 * h, 0.9 * h, a.colour
    )
    m.box(0.55 * l, l, -0.35 * w, 0.35 * w, 0.78 * h, h, shade(a.colour, 0.9), front=shade(a.colour, 0.6))
    if a.name == "cow":
        for side in (-1, 1):
            spots: Colour = (40, 36, 34) if a.colour[0] > 150 else (230, 225, 220)
            m.side_panel(side * (0.85 * w + 0.01), -0.6 * l, -0.05 * l, 0.5 * h, 0.78 * h, spots)


def _pole(m: MeshMaker, y: float, floor: float) -> None:
    m.box(-0.05, 0.05, y - 0.05, y + 0.05, -floor, 0.05, POST)


def _disc(m: MeshMaker, x: float, z: float, radius: float, colour: Colour) -> None:
    """A flat octagon that faces forwards."""
    angles = np.pi / 8 + np.arange(8) * np.pi / 4
    ring = [(x, radius * np.cos(a), z + radius * np.sin(a)) for a in angles]
    for k in (1, 3, 5):
        m.quad([ring[0], ring[k], ring[k + 1], ring[k + 2]], colour)


def add_sign(m: MeshMaker, a: Actor, l: float, w: float, h: float) -> None:
    radius = min(w, 0.5 * h)
    middle = 0.5 * h
    _pole(m, 0.0, a.kind.floor_m)
    face = a.variant % 4
    if face == 0:  # speed limit
        layers = ((1.0, (205, 20, 25)), (0.72, (248, 248, 248)))
    elif face == 1:  # no overtaking ends, drawn as a grey rim
        layers = ((1.0, (60, 60, 60)), (0.85, (246, 246, 246)))
    elif face == 2:  # mandatory
        layers = ((1.0, (25, 80, 180)), (0.35, (246, 246, 246)))
    else:
        layers = ()
        m.slope((0.02, w, 0.0), (0.02, 0.02, h), (205, 20, 25))
        m.slope((0.03, 0.62 * w, 0.14 * h), (0.03, 0.02, 0.74 * h), (248, 248, 248))
    for k, (share, colour) in enumerate(layers):
        _disc(m, 0.02 + 0.01 * k, middle, share * radius, colour)
    if face == 0:
        m.panel(0.045, -0.35 * w, -0.05 * w, 0.35 * h, 0.65 * h, 1, (20, 20, 20))
        m.panel(0.045, 0.08 * w, 0.38 * w, 0.35 * h, 0.65 * h, 1, (20, 20, 20))
    m.box(-0.03, 0.0, -0.9 * radius, 0.9 * radius, middle - 0.8 * radius, middle + 0.8 * radius, POST)


def add_gantry_sign(m: MeshMaker, a: Actor, l: float, w: float, h: float) -> None:
    ink: Colour = (245, 245, 245) if a.colour[2] > 100 else (20, 20, 20)
    m.box(-0.3 * l, 0.3 * l, -w, w, 0.0, h, POST, front=ink)
    m.panel(0.3 * l + 0.02, -0.96 * w, 0.96 * w, 0.04 * h, 0.96 * h, 1, a.colour)
    for k, (y0, y1) in enumerate(((-0.75, 0.3), (-0.75, 0.55), (-0.75, 0.1))):
        z = (0.7 - 0.24 * k) * h
        m.panel(0.3 * l + 0.04, y0 * w, y1 * w, z, z + 0.13 * h, 1, ink)
    m.panel(0.3 * l + 0.04, 0.68 * w, 0.8 * w, 0.15 * h, 0.8 * h, 1, ink)


def add_guide_sign(m: MeshMaker, a: Actor, l: float, w: float, h: float) -> None:
    add_gantry_sign(m, a, l, w, h)
    for y in (-0.6 * w, 0.6 * w):
        _pole(m, y, a.kind.floor_m)


def add_temporary_sign(m: MeshMaker, a: Actor, l: float, w: float, h: float) -> None:
    m.box(-0.03, 0.0, -w, w, 0.0, h, POST)
    m.panel(0.01, -w, w, 0.0, h, 1, a.colour)
    m.slope((0.03, 0.8 * w, 0.12 * h), (0.03, 0.02, 0.88 * h), (205, 20, 25))
    m.slope((0.04, 0.45 * w, 0.22 * h), (0.04, 0.02, 0.65 * h), (248, 248, 248))
    for y in (-0.7 * w, 0.7 * w):
        m.box(-0.2, 0.2, y - 0.05, y + 0.05, -a.kind.floor_m, 0.05, STEEL)


def add_post(m: MeshMaker, a: Actor, l: float, w: float, h: float) -> None:
    m.box(-0.5 * l, 0.5 * l, -0.5 * w, 0.5 * w, 0.0, 0.72 * h, a.colour)
    m.box(-0.5 * l, 0.5 * l, -0.5 * w, 0.5 * w, 0.72 * h, 0.9 * h, (30, 30, 30))
    m.box(-0.5 * l, 0.5 * l, -0.5 * w, 0.5 * w, 0.9 * h, h, a.colour)


def add_crate(m: MeshMaker, a: Actor, l: float, w: float, h: float) -> None:
    m.box(-l, l, -w, w, 0.0, h, a.colour, top=shade(a.colour, 1.1))


def add_bush(m: MeshMaker, a: Actor, l: float, w: float, h: float) -> None:
    m.frustum((-0.7 * l, 0.7 * l, -0.7 * w, 0.7 * w), (-l, l, -w, w), 0.0, 0.45 * h, a.colour)
    m.frustum((-l, l, -w, w), (-0.4 * l, 0.4 * l, -0.4 * w, 0.4 * w), 0.45 * h, h, shade(a.colour, 1.12))


def add_lamp_post(m: MeshMaker, a: Actor, l: float, w: float, h: float) -> None:
    m.box(-0.09, 0.09, -0.09, 0.09, 0.0, h, a.colour)
    m.box(-0.08, 0.08, -0.9, 0.9, h - 0.15, h, a.colour)
