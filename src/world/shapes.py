"""The mesh of every kind of object."""

from __future__ import annotations

from collections.abc import Callable

from src.world import small_shapes, vehicle_shapes
from src.world.mesh import Mesh, MeshMaker
from src.world.placement import Actor

_SHAPES: dict[str, Callable[[MeshMaker, Actor], None]] = {
    "car": vehicle_shapes.add_car,
    "van": vehicle_shapes.add_van,
    "tractor_unit": vehicle_shapes.add_tractor_unit,
    "rigid_truck": vehicle_shapes.add_rigid_truck,
    "trailer": vehicle_shapes.add_trailer,
    "bus": vehicle_shapes.add_bus,
    "bendy_bus": vehicle_shapes.add_bendy_bus,
    "excavator": vehicle_shapes.add_excavator,
    "farm_tractor": vehicle_shapes.add_farm_tractor,
    "motorcycle": small_shapes.add_motorcycle,
    "bicycle": small_shapes.add_bicycle,
    "person": small_shapes.add_person,
    "worker": small_shapes.add_worker,
    "cone": small_shapes.add_cone,
    "barrier": small_shapes.add_barrier,
    "animal": small_shapes.add_animal,
    "sign": small_shapes.add_sign,
    "guide_sign": small_shapes.add_guide_sign,
    "gantry_sign": small_shapes.add_gantry_sign,
    "temporary_sign": small_shapes.add_temporary_sign,
    "post": small_shapes.add_post,
    "crate": small_shapes.add_crate,
    "bush": small_shapes.add_bush,
    "lamp_post": small_shapes.add_lamp_post,
}


def build_mesh(actor: Actor) -> Mesh:
    """The mesh of one actor, in its own axes above the middle of its box's underside."""
    maker = MeshMaker()
    _SHAPES[actor.kind.shape](maker, actor)
    return maker.mesh()
