"""Coloured quads: the only thing that the camera renderer and the ray-cast lidar know of an object."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import numpy as np

Array = np.ndarray
Colour = tuple[int, int, int]
Edge = tuple[float, float, float]

TYRE: Colour = (24, 24, 26)


def shade(colour: Colour, factor: float) -> Colour:
    """The colour, lighter or darker."""
    return tuple(int(min(255, c * factor)) for c in colour)  # type: ignore[return-value]


@dataclass(kw_only=True)
class Mesh:
    """Q quads. Corners run counter-clockwise seen from outside; a triangle repeats its last corner."""

    corners: Array  # [Q, 4, 3] m
    colours: Array  # [Q, 3] 0..255
    glows: Array  # [Q] bool: shines by itself
    open: Array  # [Q] bool: seen from both sides

    def __len__(self) -> int:
        return len(self.corners)

    @classmethod
    def join(cls, meshes: list[Mesh]) -> Mesh:
        """All quads in one mesh; the list may be empty."""
        if not meshes:
            return MeshMaker().mesh()
        return cls(**{f.name: np.concatenate([getattr(m, f.name) for m in meshes]) for f in fields(cls)})

    def __getitem__(self, rows: Array) -> Mesh:
        return Mesh(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})

    def moved(self, offset: Array, yaw: float) -> Mesh:
        """The mesh turned about z, then shifted."""
        cos, sin = np.cos(yaw), np.sin(yaw)
        turn = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        return replace(self, corners=self.corners @ turn + offset)


@dataclass
class MeshMaker:
    """Collects quads of boxes, frustums, discs and panels in an object's own axes (x forward, y left, z up)."""

    quads: list[tuple[Array, Colour, bool, bool]] = field(default_factory=list)  # the rows of a mesh

    def quad(self, points: object, colour: Colour, *, glow: bool = False, two_sided: bool = False) -> None:
        """One quad of four corner points."""
        self.quads.append((np.asarray(points, dtype=np.float64), colour, glow, two_sided))

    def slope(self, low: Edge, high: Edge, colour: Colour, *, two_sided: bool = False) -> None:
        """A quad across the object between two edges, each (x, half width, z)."""
        (x0, y0, z0), (x1, y1, z1) = low, high
        self.quad([(x0, -y0, z0), (x0, y0, z0), (x1, y1, z1), (x1, -y1, z1)], colour, two_sided=two_sided)

    def frustum(
        self,
        low: tuple[float, float, float, float],
        high: tuple[float, float, float, float],
        z0: float,
        z1: float,
        colour: Colour,
        *,
        top: Colour | None = None,
        front: Colour | None = None,
    ) -> None:
        """A box with slanted sides; `low` and `high` are (x0, x1, y0, y1) at the heights z0 and z1. No underside."""
        p = [(xy[i], xy[j], z) for xy, z in ((low, z0), (high, z1)) for i, j in ((0, 2), (1, 2), (1, 3), (0, 3))]
        faces = [
            ((0, 1, 5, 4), colour),
            ((1, 2, 6, 5), front or colour),
            ((2, 3, 7, 6), colour),
            ((3, 0, 4, 7), colour),
            ((4, 5, 6, 7), top or colour),
        ]
        for indices, paint in faces:
            self.quad([p[i] for i in indices], paint)

    def box(
        self, x0: float, x1: float, y0: float, y1: float, z0: float, z1: float, colour: Colour, **faces: object
    ) -> None:
        """An upright box without underside."""
        self.frustum((x0, x1, y0, y1), (x0, x1, y0, y1), z0, z1, colour, **faces)  # type: ignore[arg-type]

    def wheel(self, x: float, y: float, radius: float, side: int, hub: Colour = (120, 120, 124)) -> None:
        """A six-sided disc that faces `side` (+1 left, -1 right)."""
        for size, paint, lift in ((1.0, TYRE, 0.0), (0.5, hub, 0.012)):
            angles = side * -np.arange(6) * np.pi / 3
            ring = [
                (x + size * radius * np.cos(a), y + side * lift, radius + size * radius * np.sin(a)) for a in angles
            ]
            self.quad(ring[0:4], paint, two_sided=True)
            self.quad([ring[0], ring[3], ring[4], ring[5]], paint, two_sided=True)

    def wheels(self, axles: list[float], half_width: float, radius: float) -> None:
        """Wheels on both sides, slightly outside the body."""
        for x in axles:
            for side in (1, -1):
                self.wheel(x, side * (half_width + 0.012), radius, side)

    def panel(
        self, x: float, y0: float, y1: float, z0: float, z1: float, facing: int, colour: Colour, *, glow: bool = False
    ) -> None:
        """A flat upright rectangle across the object that faces forwards (+1) or backwards (-1)."""
        left, right = (y1, y0) if facing < 0 else (y0, y1)
        self.quad([(x, left, z0), (x, right, z0), (x, right, z1), (x, left, z1)], colour, glow=glow)

    def side_panel(self, y: float, x0: float, x1: float, z0: float, z1: float, colour: Colour) -> None:
        """A flat upright rectangle along the object on the side of the sign of y."""
        first, last = (x0, x1) if y < 0 else (x1, x0)
        self.quad([(first, y, z0), (last, y, z0), (last, y, z1), (first, y, z1)], colour)

    def lights(self, x_front: float, x_back: float, half_width: float, z: float, size: float) -> None:
        """White lights in front and red ones behind, a little outside the body."""
        for side in (1, -1):
            outer, inner = side * half_width, side * (half_width - 1.6 * size)
            self.panel(x_front + 0.02, min(outer, inner), max(outer, inner), z, z + size, 1, (255, 250, 225), glow=True)
            self.panel(x_back - 0.02, min(outer, inner), max(outer, inner), z, z + size, -1, (235, 20, 20), glow=True)

    def mesh(self) -> Mesh:
        """The collected quads as one mesh."""
        corners, colours, glows, two_sided = zip(*self.quads, strict=True) if self.quads else ((),) * 4
        return Mesh(
            corners=np.array(corners).reshape(-1, 4, 3),
            colours=np.array(colours, dtype=np.float32).reshape(-1, 3),
            glows=np.array(glows, dtype=bool),
            open=np.array(two_sided, dtype=bool),
        )
