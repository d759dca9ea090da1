"""What drives, walks and stands on the highway: sizes, radar cross-sections and colours per kind of object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from src.structures.taxonomy import ATTRIBUTES, CATEGORY_TO_CLASS, IGNORED_CATEGORIES

ALL_CATEGORIES = tuple(CATEGORY_TO_CLASS) + IGNORED_CATEGORIES
"""The 27 categories of the tables."""

Colour = tuple[int, int, int]


@dataclass(frozen=True, kw_only=True)
class Kind:
    """One kind of object. Sizes are drawn from normal distributions cut at two standard deviations."""

    category: str | None  # None: scenery that looks like an object to the radar but is not labelled
    shape: str  # which mesh of `shapes.py`
    size_m: tuple[float, float, float]  # mean length, width, height
    spread_m: tuple[float, float, float]  # standard deviations
    rcs_db: float  # mean radar cross-section, dB over 1 m2
    returns: float  # candidate returns per sweep of a near object, without its extent
    colours: tuple[Colour, ...]
    micro_doppler_mps: float = 0.0  # spread by wheels and limbs
    floor_m: float = 0.0  # height of the lower edge above the ground

    def draw_size(self, rng: np.random.Generator) -> np.ndarray:
        """Length, width, height in m."""
        return np.asarray(self.size_m) + np.asarray(self.spread_m) * np.clip(rng.standard_normal(3), -2, 2)

    @property
    def klass(self) -> str | None:
        """Detection class, None for scenery and ignored categories."""
        return CATEGORY_TO_CLASS.get(self.category or "")


CAR_PAINT: tuple[Colour, ...] = (
    (30, 32, 36),
    (190, 192, 196),
    (235, 235, 235),
    (110, 114, 120),
    (150, 24, 26),
    (28, 58, 120),
    (70, 80, 70),
    (200, 150, 40),
)
CAB_PAINT: tuple[Colour, ...] = (
    (200, 40, 35),
    (235, 235, 235),
    (30, 70, 150),
    (240, 190, 40),
    (40, 110, 60),
    (60, 60, 66),
)
CARGO_PAINT: tuple[Colour, ...] = (
    (238, 238, 236),
    (210, 210, 205),
    (40, 90, 160),
    (190, 60, 40),
    (60, 130, 80),
    (230, 170, 60),
)
CLOTHES: tuple[Colour, ...] = (
    (50, 60, 110),
    (150, 40, 50),
    (60, 90, 60),
    (40, 40, 44),
    (190, 170, 140),
    (110, 60, 120),
)
GREENS: tuple[Colour, ...] = ((58, 92, 40), (76, 104, 48), (50, 78, 42), (94, 108, 56))

KINDS: dict[str, Kind] = {
    "car": Kind(
        category="vehicle.car",
        shape="car",
        size_m=(4.6, 1.85, 1.5),
        spread_m=(0.3, 0.07, 0.1),
        rcs_db=10,
        returns=2.0,
        colours=CAR_PAINT,
        micro_doppler_mps=0.25,
    ),
    "van": Kind(
        category="vehicle.car",
        shape="van",
        size_m=(5.6, 2.05, 2.4),
        spread_m=(0.4, 0.06, 0.2),
        rcs_db=12,
        returns=2.2,
        colours=((238, 238, 236), (240, 200, 40), (60, 90, 150), (120, 124, 128)),
        micro_doppler_mps=0.25,
    ),
    "rigid_truck": Kind(
        category="vehicle.truck",
        shape="rigid_truck",
        size_m=(9.2, 2.55, 3.6),
        spread_m=(0.8, 0.05, 0.2),
        rcs_db=18,
        returns=3.0,
        colours=CAB_PAINT,
        micro_doppler_mps=0.35,
    ),
    "tractor_unit": Kind(
        category="vehicle.truck",
        shape="tractor_unit",
        size_m=(6.2, 2.55, 3.7),
        spread_m=(0.25, 0.04, 0.15),
        rcs_db=17,
        returns=3.0,
        colours=CAB_PAINT,
        micro_doppler_mps=0.35,
    ),
    "semi_trailer": Kind(
        category="vehicle.trailer",
        shape="trailer",
        size_m=(13.6, 2.55, 4.0),
        spread_m=(0.3, 0.04, 0.05),
        rcs_db=18,
        returns=3.0,
        colours=CARGO_PAINT,
        micro_doppler_mps=0.35,
    ),
    "drawbar_trailer": Kind(
        category="vehicle.trailer",
        shape="trailer",
        size_m=(8.4, 2.55, 3.7),
        spread_m=(0.6, 0.04, 0.15),
        rcs_db=17,
        returns=2.8,
        colours=CARGO_PAINT,
        micro_doppler_mps=0.35,
    ),
    "bus": Kind(
        category="vehicle.bus.rigid",
        shape="bus",
        size_m=(12.2, 2.55, 3.3),
        spread_m=(0.6, 0.03, 0.15),
        rcs_db=18,
        returns=3.0,
        colours=((40, 110, 190), (230, 80, 30), (70, 160, 70), (236, 236, 230)),
        micro_doppler_mps=0.35,
    ),
    "bendy_bus": Kind(
        category="vehicle.bus.bendy",
        shape="bendy_bus",
        size_m=(17.8, 2.55, 3.2),
        spread_m=(0.3, 0.03, 0.1),
        rcs_db=18,
        returns=3.2,
        colours=((230, 190, 30), (190, 30, 40)),
        micro_doppler_mps=0.35,
    ),
    "excavator": Kind(
        category="vehicle.construction",
        shape="excavator",
        size_m=(7.4, 2.6, 3.2),
        spread_m=(0.4, 0.1, 0.15),
        rcs_db=16,
        returns=3.0,
        colours=((242, 178, 20),),
    ),
    "farm_tractor": Kind(
        category="vehicle.other",
        shape="farm_tractor",
        size_m=(4.9, 2.3, 2.9),
        spread_m=(0.3, 0.1, 0.1),
        rcs_db=14,
        returns=2.6,
        colours=((50, 130, 40), (180, 30, 25), (40, 90, 170)),
        micro_doppler_mps=0.5,
    ),
    "motorcycle": Kind(
        category="vehicle.motorcycle",
        shape="motorcycle",
        size_m=(2.15, 0.8, 1.5),
        spread_m=(0.1, 0.05, 0.05),
        rcs_db=3,
        returns=1.8,
        colours=((170, 30, 30), (30, 60, 150), (30, 30, 34), (40, 140, 60)),
        micro_doppler_mps=0.5,
    ),
    "bicycle": Kind(
        category="vehicle.bicycle",
        shape="bicycle",
        size_m=(1.8, 0.6, 1.7),
        spread_m=(0.08, 0.04, 0.06),
        rcs_db=-1,
        returns=1.8,
        colours=((30, 120, 180), (200, 60, 40), (30, 30, 34)),
        micro_doppler_mps=0.6,
    ),
    "adult": Kind(
        category="human.pedestrian.adult",
        shape="person",
        size_m=(0.65, 0.65, 1.76),
        spread_m=(0.08, 0.06, 0.08),
        rcs_db=-3,
        returns=1.8,
        colours=CLOTHES,
        micro_doppler_mps=0.5,
    ),
    "child": Kind(
        category="human.pedestrian.child",
        shape="person",
        size_m=(0.5, 0.5, 1.25),
        spread_m=(0.05, 0.05, 0.1),
        rcs_db=-6,
        returns=1.6,
        colours=CLOTHES,
        micro_doppler_mps=0.5,
    ),
    "worker": Kind(
        category="human.pedestrian.construction_worker",
        shape="worker",
        size_m=(0.7, 0.68, 1.8),
        spread_m=(0.08, 0.06, 0.06),
        rcs_db=-3,
        returns=1.8,
        colours=((255, 110, 20),),
        micro_doppler_mps=0.4,
    ),
    "police_officer": Kind(
        category="human.pedestrian.police_officer",
        shape="worker",
        size_m=(0.7, 0.68, 1.8),
        spread_m=(0.06, 0.05, 0.06),
        rcs_db=-3,
        returns=1.8,
        colours=((225, 235, 40),),
        micro_doppler_mps=0.4,
    ),
    "cone": Kind(
        category="movable_object.trafficcone",
        shape="cone",
        size_m=(0.42, 0.42, 0.8),
        spread_m=(0.03, 0.03, 0.08),
        rcs_db=-9,
        returns=1.5,
        colours=((250, 90, 15),),
    ),
    "barrier": Kind(
        category="movable_object.barrier",
        shape="barrier",
        size_m=(0.5, 2.3, 1.0),
        spread_m=(0.06, 0.3, 0.08),
        rcs_db=2,
        returns=1.8,
        colours=((215, 30, 30),),
    ),
    "deer": Kind(
        category="animal",
        shape="animal",
        size_m=(1.7, 0.55, 1.4),
        spread_m=(0.15, 0.06, 0.12),
        rcs_db=-3,
        returns=1.8,
        colours=((140, 92, 52), (120, 80, 50)),
        micro_doppler_mps=0.2,
    ),
    "cow": Kind(
        category="animal",
        shape="animal",
        size_m=(2.3, 0.8, 1.5),
        spread_m=(0.12, 0.06, 0.08),
        rcs_db=0,
        returns=2.0,
        colours=((235, 230, 222), (90, 56, 36), (40, 36, 34)),
        micro_doppler_mps=0.15,
    ),
    "sign": Kind(
        category="static_object.traffic_sign",
        shape="sign",
        size_m=(0.2, 0.8, 0.8),
        spread_m=(0.03, 0.08, 0.08),
        rcs_db=6,
        returns=1.8,
        colours=((255, 255, 255),),
        floor_m=2.0,
    ),
    "guide_sign": Kind(
        category="static_object.traffic_sign",
        shape="guide_sign",
        size_m=(0.3, 3.2, 2.2),
        spread_m=(0.04, 0.4, 0.3),
        rcs_db=10,
        returns=2.2,
        colours=((20, 70, 170), (230, 190, 20)),
        floor_m=1.8,
    ),
    "gantry_sign": Kind(
        category="static_object.traffic_sign",
        shape="gantry_sign",
        size_m=(0.4, 3.3, 2.3),
        spread_m=(0.04, 0.3, 0.2),
        rcs_db=12,
        returns=2.2,
        colours=((20, 70, 170),),
        floor_m=5.4,
    ),
    "temporary_sign": Kind(
        category="static_object.traffic_sign",
        shape="temporary_sign",
        size_m=(0.2, 0.9, 1.0),
        spread_m=(0.02, 0.08, 0.1),
        rcs_db=5,
        returns=1.8,
        colours=((250, 210, 30),),
        floor_m=0.5,
    ),
    # Unlabelled look-alikes: the radar alone cannot tell them from cones, barriers, signs, people or parked vehicles.
    "bollard": Kind(
        category=None,
        shape="post",
        size_m=(0.25, 0.25, 0.9),
        spread_m=(0.03, 0.03, 0.1),
        rcs_db=-9,
        returns=1.5,
        colours=((235, 235, 235),),
    ),
    "cabinet": Kind(
        category=None,
        shape="crate",
        size_m=(0.6, 1.3, 1.2),
        spread_m=(0.1, 0.3, 0.2),
        rcs_db=3,
        returns=1.8,
        colours=((120, 126, 120), (150, 150, 146)),
    ),
    "concrete_block": Kind(
        category=None,
        shape="crate",
        size_m=(0.6, 2.3, 0.9),
        spread_m=(0.1, 0.4, 0.1),
        rcs_db=2,
        returns=1.8,
        colours=((160, 158, 150),),
    ),
    "hay_bale": Kind(
        category=None,
        shape="crate",
        size_m=(1.4, 1.3, 1.3),
        spread_m=(0.1, 0.1, 0.1),
        rcs_db=-2,
        returns=1.9,
        colours=((196, 172, 92),),
    ),
    "bush": Kind(
        category=None,
        shape="bush",
        size_m=(1.5, 1.3, 1.4),
        spread_m=(0.4, 0.3, 0.3),
        rcs_db=-4,
        returns=1.9,
        colours=GREENS,
    ),
    "lamp_post": Kind(
        category=None,
        shape="lamp_post",
        size_m=(0.3, 0.3, 8.0),
        spread_m=(0.04, 0.04, 0.5),
        rcs_db=6,
        returns=1.9,
        colours=((130, 134, 138),),
    ),
    "container": Kind(
        category=None,
        shape="crate",
        size_m=(6.1, 2.44, 2.6),
        spread_m=(0.2, 0.02, 0.1),
        rcs_db=16,
        returns=3.0,
        colours=((40, 90, 80), (150, 70, 40), (80, 90, 110)),
    ),
}


def attribute_of(kind: Kind, speed_mps: float, *, has_rider: bool, parked: bool) -> str | None:
    """The TruckScenes attribute of an object that moves at this speed; None for classes without one."""
    klass = kind.klass
    if klass in ("car", "truck", "bus", "trailer", "other_vehicle"):
        name = "vehicle.parked" if parked else "vehicle.moving" if speed_mps > 0.5 else "vehicle.stopped"
    elif klass in ("motorcycle", "bicycle"):
        name = "cycle.with_rider" if has_rider else "cycle.without_rider"
    elif klass == "pedestrian":
        name = "pedestrian.moving" if speed_mps > 0.3 else "pedestrian.standing"
    elif klass == "traffic_sign":
        postures = {"gantry_sign": "overhanging", "temporary_sign": "temporary"}
        name = "traffic_sign." + postures.get(kind.shape, "pole_mounted")
    else:
        return None
    if name not in ATTRIBUTES:
        raise ValueError(f"attribute {name} is not one of the TruckScenes attributes")
    return name
