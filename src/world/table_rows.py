"""The 14 TruckScenes tables of a world: rows of one scene, and the rows that all scenes share."""

from __future__ import annotations

import hashlib
from collections import defaultdict

import numpy as np

from src.structures.taxonomy import ATTRIBUTES
from src.world.catalogue import ALL_CATEGORIES
from src.world.rig import Mount

Array = np.ndarray
Row = dict[str, object]
Tables = dict[str, list[Row]]


def token(*parts: object) -> str:
    """32 hexadecimal digits that depend on the parts alone."""
    return hashlib.blake2b("/".join(map(str, parts)).encode(), digest_size=16).hexdigest()


def quaternions(rotations: Array) -> Array:
    """(w, x, y, z) with w >= 0 of rotation matrices [T, 3, 3] whose angle is below 180 degrees or exactly there."""
    m = np.asarray(rotations)
    squares = np.stack(
        [
            1 + m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2],
            1 + m[:, 0, 0] - m[:, 1, 1] - m[:, 2, 2],
            1 - m[:, 0, 0] + m[:, 1, 1] - m[:, 2, 2],
            1 - m[:, 0, 0] - m[:, 1, 1] + m[:, 2, 2],
        ],
        1,
    )
    # Row k of this symmetric matrix is 4 q_k q; the row with the largest diagonal is the best conditioned.
    products = np.zeros((len(m), 4, 4))
    products[:, range(4), range(4)] = squares
    for a, b, value in (
        (0, 1, m[:, 2, 1] - m[:, 1, 2]),
        (0, 2, m[:, 0, 2] - m[:, 2, 0]),
        (0, 3, m[:, 1, 0] - m[:, 0, 1]),
        (1, 2, m[:, 1, 0] + m[:, 0, 1]),
        (1, 3, m[:, 0, 2] + m[:, 2, 0]),
        (2, 3, m[:, 2, 1] + m[:, 1, 2]),
    ):
        products[:, a, b] = products[:, b, a] = value
    best = products[np.arange(len(m)), squares.argmax(1)]
    best = best / np.linalg.norm(best, axis=1, keepdims=True)
    return np.where(best[:, :1] < 0, -best, best)


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
                "rotation": rounded(quaternions(mount.rotation[None])[0], 12),
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


def link_by(rows: list[Row], key: str) -> None:
    """Link each group of rows that agree in `key`, in their order."""
    groups: dict[object, list[Row]] = defaultdict(list)
    for row in rows:
        groups[row[key]].append(row)
    for group in groups.values():
        link_chain(group)
