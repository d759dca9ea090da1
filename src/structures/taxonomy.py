"""Classes, attributes, channels and evaluation ranges of MAN TruckScenes, whose tables stand in taxonomy.yaml, and what
else all parts call by one name. Imports no torch."""

from __future__ import annotations

from enum import IntEnum
from pathlib import Path

import yaml

_TAXONOMY = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8"))
_CLASSES = _TAXONOMY["classes"]

CLASSES: tuple[str, ...] = tuple(_CLASSES)
CLASS_RANGE_M: dict[str, float] = {name: of_class["range_m"] for name, of_class in _CLASSES.items()}
"""A box counts if its xy distance to the ego of the LIDAR_LEFT key frame is below this."""

ATTRIBUTES: tuple[str, ...] = tuple(_TAXONOMY["attributes"])
CLASS_ATTRIBUTE_PREFIX: dict[str, str | None] = {name: of_class["attributes"] for name, of_class in _CLASSES.items()}
"""Which attributes a class can carry; None for none."""

CLASS_WITHOUT_ERRORS: dict[str, list[str]] = {
    name: of_class.get("undefined_errors", []) for name, of_class in _CLASSES.items()
}
"""Errors that are undefined for a class and left out of the means."""

CATEGORY_TO_CLASS: dict[str, str] = {
    category: name for name, of_class in _CLASSES.items() for category in of_class["categories"]
}
BICYCLE_RACK = "static_object.bicycle_rack"
IGNORED_CATEGORIES: tuple[str, ...] = tuple(_TAXONOMY["ignored_categories"])

SCENE_TAGS = tuple(f"{group}.{name}" for group, names in _TAXONOMY["scene_tags"].items() for name in names)
TAGS_WITHOUT_SCORE: tuple[str, ...] = tuple(_TAXONOMY["tags_without_score"])
"""The official evaluation reports NaN for these, whatever the boxes are."""

SENSORS = ("camera", "radar", "lidar")
"""The kinds of sensors that a model may use."""
CAMERAS: tuple[str, ...] = tuple(_TAXONOMY["cameras"])
RADARS: tuple[str, ...] = tuple(_TAXONOMY["radars"])
LIDARS: tuple[str, ...] = tuple(_TAXONOMY["lidars"])
REFERENCE_CHANNEL = "LIDAR_LEFT"
"""Its key frame defines ego(t): the frame of all network geometry and of evaluation ranges."""

EGO_BODY_M = ((-12.0, -1.5, 0.3), (6.0, 1.5, 4.3))
"""Lowest and highest corner of the truck with its trailer, ego frame [ours]."""

MOVING_MPS = 1.0
"""What is faster over ground moves: in losses, scores and pictures."""

SPEED_UNIT_MPS = 10.0
"""In which networks state velocities: their targets are ten times those of their neighbours, which one learning rate
would otherwise not reach in a short training. Losses and outputs stay in m/s."""

MAX_BOXES_PER_SAMPLE = 500
"""The official evaluator refuses more."""


class Source(IntEnum):
    """Where a Gaussian came from."""

    RADAR = 0
    CAMERA = 1
    RANDOM = 2
    HISTORY = 3


SOURCES = tuple(source.name.lower() for source in Source)
"""Their names in pictures and tables."""
