"""The mesh of every kind of object."""

from __future__ import annotations

from src.world import small_shapes, vehicle_shapes
from src.world.mesh import Mesh, MeshMaker
from src.world.placement import Actor

_SHAPES = vars(small_shapes) | vars(vehicle_shapes)


def build_mesh(actor: Actor) -> Mesh:
    """The mesh of one actor, in its own axes above the middle of its box's underside."""
    maker = MeshMaker()
    _SHAPES[f"add_{actor.kind.shape}"](maker, actor, *(actor.size * [0.5, 0.5, 1.0]))
    return maker.mesh()
