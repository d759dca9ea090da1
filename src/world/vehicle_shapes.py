"""Vehicles with cabins. Origin: middle of the underside; x forward. Everything lies inside the box.

l and w are half its length and width, h its height, all in metres.
"""

from __future__ import annotations

from src.world.mesh import Colour, MeshMaker, shade
from src.world.placement import Actor

GLASS: Colour = (38, 48, 60)
STEEL: Colour = (90, 92, 96)


def add_car(m: MeshMaker, a: Actor, l: float, w: float, h: float) -> None:
    belt = 0.58 * h
    m.frustum((-l, l, -w, w), (-l * 0.98, l * 0.97, -w * 0.97, w * 0.97), 0.17 * h, belt, a.colour)
    m.frustum(
        (-0.86 * l, 0.45 * l, -0.92 * w, 0.92 * w),
        (-0.62 * l, 0.12 * l, -0.76 * w, 0.76 * w),
        belt,
        h,
        GLASS,
        top=a.colour,
    )
    m.wheels([-0.58 * l, 0.62 * l], w, 0.22 * h)
    m.lights(l, -l, 0.94 * w, 0.38 * h, 0.13 * h)
    m.panel(l + 0.01, -0.5 * w, 0.5 * w, 0.2 * h, 0.34 * h, 1, (40, 40, 42))
    m.panel(-l - 0.01, -0.28 * w, 0.28 * w, 0.3 * h, 0.4 * h, -1, (245, 245, 240))


def add_van(m: MeshMaker, a: Actor, l: float, w: float, h: float) -> None:
    m.box(-l, 0.45 * l, -w, w, 0.12 * h, h, a.colour)
    m.frustum((0.45 * l, l, -w, w), (0.45 * l, 0.62 * l, -0.94 * w, 0.94 * w), 0.12 * h, 0.97 * h, a.colour)
    m.slope((0.845 * l, 0.85 * w, 0.48 * h), (0.66 * l, 0.85 * w, 0.9 * h), GLASS, two_sided=True)
    for side in (-1, 1):
        m.side_panel(side * (w + 0.01), 0.36 * l, 0.7 * l, 0.52 * h, 0.85 * h, GLASS)
    m.panel(-l - 0.01, -0.8 * w, 0.8 * w, 0.55 * h, 0.85 * h, -1, GLASS)
    m.wheels([-0.6 * l, 0.66 * l], w, 0.15 * h)
    m.lights(l, -l, 0.94 * w, 0.28 * h, 0.09 * h)


def _cab(m: MeshMaker, a: Actor, front: float, depth: float, w: float, h: float) -> None:
    """A cab-over driver's cabin that ends at x = front."""
    back = front - depth
    m.frustum((back, front, -w, w), (back, front - 0.25, -w, w), 0.13 * h, h, a.colour)
    m.slope((front - 0.09, 0.9 * w, 0.5 * h), (front - 0.16, 0.9 * w, 0.8 * h), GLASS, two_sided=True)
    m.panel(front + 0.01, -0.7 * w, 0.7 * w, 0.17 * h, 0.42 * h, 1, (36, 36, 40))
    for side in (-1, 1):
        m.side_panel(side * (w + 0.01), front - 0.6 * depth, front - 0.25, 0.5 * h, 0.78 * h, GLASS)


def add_tractor_unit(m: MeshMaker, a: Actor, l: float, w: float, h: float) -> None:
    _cab(m, a, l, 2.3, w, h)
    m.box(-l, l - 2.3, -0.4 * w, 0.4 * w, 0.17 * h, 0.28 * h, STEEL)
    m.wheels([l - 1.4, -l + 1.1], w - 0.02, 0.5)
    m.lights(l, -l, 0.94 * w, 0.2 * h, 0.2)


def add_rigid_truck(m: MeshMaker, a: Actor, l: float, w: float, h: float) -> None:
    cargo: Colour = ((238, 238, 236), (205, 200, 190), (70, 110, 170))[a.variant % 3]
    _cab(m, a, l, 2.1, w, h)
    m.box(-l, l - 2.3, -w, w, 0.3 * h, h, cargo, top=shade(cargo, 0.9))
    m.box(-l, l - 2.1, -0.4 * w, 0.4 * w, 0.14 * h, 0.3 * h, STEEL)
    m.wheels([l - 1.3, -l + 1.4, -l + 2.6], w - 0.02, 0.5)
    m.lights(l, -l, 0.94 * w, 0.18 * h, 0.2)
    m.panel(-l - 0.01, -0.04, 0.04, 0.32 * h, 0.98 * h, -1, shade(cargo, 0.55))


def add_lorry(m: MeshMaker, a: Actor, l: float, w: float, h: float) -> None:
    cargo: Colour = ((238, 238, 236), (60, 110, 170), (205, 200, 190), (190, 70, 50))[a.variant % 4]
    _cab(m, a, l, 2.3, w, 0.94 * h)
    m.box(-l, l - 2.9, -w, w, 0.28 * h, h, cargo, top=shade(cargo, 0.9))
    m.box(-l, l - 2.3, -0.4 * w, 0.4 * w, 0.14 * h, 0.28 * h, STEEL)
    for side in (-1, 1):
        m.side_panel(side * (w + 0.01), -0.7 * l, 0.4 * l, 0.5 * h, 0.78 * h, shade(cargo, 0.62))
    m.wheels([l - 1.4, l - 5.0, -l + 2.2, -l + 3.5, -l + 4.8], w - 0.02, 0.5)
    m.lights(l, -l, 0.94 * w, 0.2 * h, 0.2)
    m.panel(-l - 0.01, -0.05, 0.05, 0.3 * h, 0.98 * h, -1, shade(cargo, 0.45))


def add_trailer(m: MeshMaker, a: Actor, l: float, w: float, h: float) -> None:
    m.box(-l, l, -w, w, 0.28 * h, h, a.colour, top=shade(a.colour, 0.9))
    m.box(-l, 0.3 * l, -0.4 * w, 0.4 * w, 0.16 * h, 0.28 * h, STEEL)
    m.wheels([-0.72 * l, -0.5 * l, -0.28 * l], w - 0.02, 0.5)
    for side in (-1, 1):
        m.side_panel(side * (w + 0.01), -l, l, 0.28 * h, 0.32 * h, (190, 30, 30))
        m.side_panel(side * (w + 0.01), -0.5 * l, 0.55 * l, 0.5 * h, 0.78 * h, shade(a.colour, 0.62))
        m.side_panel(side * (w - 0.05), -0.1 * l, 0.5 * l, 0.12 * h, 0.27 * h, (70, 72, 76))
    m.lights(l - 0.05, -l, 0.94 * w, 0.2 * h, 0.22)
    m.panel(-l - 0.01, -0.05, 0.05, 0.3 * h, 0.98 * h, -1, shade(a.colour, 0.45))
    for y in (-0.95 * w, 0.55 * w):
        m.panel(-l - 0.012, y, y + 0.4 * w, 0.29 * h, 0.35 * h, -1, (230, 190, 40))


def add_bus(m: MeshMaker, a: Actor, l: float, w: float, h: float) -> None:
    m.box(-l, l, -w, w, 0.1 * h, h, a.colour, top=(225, 225, 225))
    for side in (-1, 1):
        for k in range(6):
            x0 = -0.94 * l + k * 0.315 * l
            m.side_panel(side * (w + 0.01), x0, x0 + 0.27 * l, 0.47 * h, 0.84 * h, GLASS)
    m.side_panel(-w - 0.015, 0.7 * l, 0.84 * l, 0.12 * h, 0.82 * h, (60, 72, 86))
    m.panel(l + 0.01, -0.92 * w, 0.92 * w, 0.36 * h, 0.84 * h, 1, GLASS)
    m.panel(l + 0.015, -0.7 * w, 0.7 * w, 0.86 * h, 0.96 * h, 1, (255, 170, 40), glow=True)
    m.panel(-l - 0.01, -0.85 * w, 0.85 * w, 0.55 * h, 0.85 * h, -1, GLASS)
    m.wheels([0.55 * l, -0.5 * l], w, 0.5)
    m.lights(l, -l, 0.94 * w, 0.17 * h, 0.2)


def add_bendy_bus(m: MeshMaker, a: Actor, l: float, w: float, h: float) -> None:
    add_bus(m, a, l, w, h)
    for side in (-1, 1):
        m.side_panel(side * (w + 0.03), -0.12 * l, 0.06 * l, 0.1 * h, h, (40, 40, 42))
    m.wheels([-0.2 * l], w, 0.5)


def add_excavator(m: MeshMaker, a: Actor, l: float, w: float, h: float) -> None:
    for side in (-1, 1):
        m.box(-0.95 * l, 0.3 * l, side * w * 0.62 - 0.38 * w, side * w * 0.62 + 0.38 * w, 0.0, 0.26 * h, (44, 44, 46))
    m.box(-l, 0.25 * l, -0.85 * w, 0.85 * w, 0.3 * h, 0.62 * h, a.colour)
    m.box(-0.25 * l, 0.25 * l, 0.05 * w, 0.85 * w, 0.62 * h, h, GLASS, top=a.colour)
    m.frustum(
        (0.1 * l, 0.3 * l, -0.35 * w, -0.05 * w), (0.55 * l, 0.7 * l, -0.35 * w, -0.05 * w), 0.5 * h, 0.98 * h, a.colour
    )
    m.frustum(
        (0.82 * l, 0.95 * l, -0.33 * w, -0.07 * w),
        (0.55 * l, 0.7 * l, -0.33 * w, -0.07 * w),
        0.25 * h,
        0.98 * h,
        a.colour,
    )
    m.box(0.7 * l, l, -0.55 * w, 0.15 * w, 0.02 * h, 0.26 * h, (70, 70, 72))


def add_farm_tractor(m: MeshMaker, a: Actor, l: float, w: float, h: float) -> None:
    m.box(-0.1 * l, l, -0.4 * w, 0.4 * w, 0.3 * h, 0.6 * h, a.colour)
    m.frustum(
        (-0.9 * l, 0.05 * l, -0.6 * w, 0.6 * w),
        (-0.8 * l, -0.05 * l, -0.55 * w, 0.55 * w),
        0.4 * h,
        h,
        GLASS,
        top=a.colour,
    )
    for side in (-1, 1):
        m.wheel(-0.5 * l, side * w, 0.3 * h, side, hub=(230, 200, 60))
        m.wheel(0.65 * l, side * 0.85 * w, 0.2 * h, side, hub=(230, 200, 60))
        m.box(-0.95 * l, -0.1 * l, side * 0.8 * w - 0.15 * w, side * 0.8 * w + 0.15 * w, 0.5 * h, 0.6 * h, a.colour)
    m.lights(l, -0.9 * l, 0.4 * w, 0.45 * h, 0.18)
