"""What drives, walks and stands on the highway: sizes, radar cross-sections and colours of `catalogue.yaml`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from src.structures.taxonomy import CATEGORY_TO_CLASS, IGNORED_CATEGORIES

ALL_CATEGORIES = tuple(CATEGORY_TO_CLASS) + IGNORED_CATEGORIES
"""The 27 categories of the tables."""


@dataclass(frozen=True, kw_only=True)
class Kind:
    """One kind of object. Sizes are drawn from normal distributions cut at two standard deviations."""

    category: str | None  # None: scenery that looks like an object to the radar but is not labelled
    shape: str  # which function of `small_shapes` or `vehicle_shapes`
    size_m: list[float]  # mean length, width, height
    spread_m: list[float]  # standard deviations
    floor_m: float  # height of the lower edge above the ground
    rcs_db: float  # mean radar cross-section, dB over 1 m2
    returns: float  # candidate returns per sweep of a near object, without its extent
    micro_doppler_mps: float  # spread by wheels and limbs
    colours: list[list[int]]

    def draw_size(self, rng: np.random.Generator) -> np.ndarray:
        """Length, width, height in m."""
        return np.asarray(self.size_m) + np.asarray(self.spread_m) * np.clip(rng.standard_normal(3), -2, 2)

    @property
    def klass(self) -> str | None:
        """Detection class, None for scenery and ignored categories."""
        return CATEGORY_TO_CLASS.get(self.category or "")


_CATALOGUE = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8"))
KINDS = {name: Kind(**values) for name, values in _CATALOGUE["kinds"].items()}
GREENS = _CATALOGUE["colours"]["greens"]


def attribute_of(kind: Kind, speed_mps: float, *, has_rider: bool, parked: bool) -> str | None:
    """The TruckScenes attribute of an object that moves at this speed; None for classes without one."""
    klass = kind.klass
    if klass in ("car", "truck", "bus", "trailer", "other_vehicle"):
        return "vehicle.parked" if parked else "vehicle.moving" if speed_mps > 0.5 else "vehicle.stopped"
    if klass in ("motorcycle", "bicycle"):
        return "cycle.with_rider" if has_rider else "cycle.without_rider"
    if klass == "pedestrian":
        return "pedestrian.moving" if speed_mps > 0.3 else "pedestrian.standing"
    if klass == "traffic_sign":
        postures = {"gantry_sign": "overhanging", "temporary_sign": "temporary"}
        return "traffic_sign." + postures.get(kind.shape, "pole_mounted")
    return None
