"""The 14 TruckScenes tables of a world: rows of one scene, and the rows that all scenes share."""

from __future__ import annotations

import hashlib
from collections import defaultdict

import numpy as np

from src.geometry.transforms import matrix_to_quaternion
from src.structures.taxonomy import ATTRIBUTES
from src.world.catalogue import ALL_CATEGORIES
from src.world.rig import Mount

Array = np.ndarray
Row = dict[str, object]
Tables = dict[str, list[Row]]


def token(*parts: object) -> str:
    """32 hexadecimal digits that depend on the parts alone."""
    return hashlib.blake2b("/".join(map(str, parts)).encode(), digest_size=16).hexdigest()


def rounded(values: Array, digits: int) -> list[float]:
    """Plain floats for JSON."""
    return [round(float(value), digits) for value in values]


def shared_tables(seed: int, rig: dict[str, Mount]) -> Tables:
    """Categories, attributes, visibilities, sensors and calibration: the same vehicle in every scene."""
    shares = ("0-40", "40-60", "60-80", "80-100")
    return {
        "category": [
            {"token": token(seed, "category", name), "name": name, "description": name.replace(".", " "), "index": i}
            for i, name in enumerate(ALL_CATEGORIES)
        ],
        "attribute": [
            {"token": token(seed, "attribute", name), "name": name, "description": name.replace(".", " ")}
            for name in ATTRIBUTES
        ],
        "visibility": [
            {
                "token": token(seed, "visibility", i + 1),
                "level": i + 1,
                "description": f"{share} % visible in the images",
            }
            for i, share in enumerate(shares)
        ],
        "sensor": [
            {"token": token(seed, "sensor", name), "channel": name, "modality": mount.modality}
            for name, mount in rig.items()
        ],
        "calibrated_sensor": [
            {
                "token": token(seed, "calibration", name),
                "sensor_token": token(seed, "sensor", name),
                "translation": rounded(mount.translation, 6),
                "rotation": rounded(matrix_to_quaternion(mount.rotation), 12),
                "camera_intrinsic": [] if mount.intrinsic is None else [rounded(row, 9) for row in mount.intrinsic],
            }
            for name, mount in rig.items()
        ],
    }


def link_chain(rows: list[Row]) -> None:
    """Fill prev and next of rows in order; the ends are empty strings."""
    for i, row in enumerate(rows):
        row["prev"] = rows[i - 1]["token"] if i else ""
        row["next"] = rows[i + 1]["token"] if i + 1 < len(rows) else ""


def link_sensors(rows: list[Row]) -> None:
    """Link the rows of each calibrated sensor, in their order."""
    groups: dict[object, list[Row]] = defaultdict(list)
    for row in rows:
        groups[row["calibrated_sensor_token"]].append(row)
    for group in groups.values():
        link_chain(group)
