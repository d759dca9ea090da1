"""Point cloud files with the real data's headers (PCD 0.7, little endian)."""

from __future__ import annotations

import struct

import numpy as np

Array = np.ndarray

RADAR_FIELDS = ("x", "y", "z", "vrel_x", "vrel_y", "vrel_z", "rcs")
LIDAR_TYPE = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("timestamp", "<u8")])


def _header(fields: tuple[str, ...], sizes: list[int], types: list[str], points: int, encoding: str) -> bytes:
    lines = [
        "VERSION 0.7",
        "FIELDS " + " ".join(fields),
        "SIZE " + " ".join(map(str, sizes)),
        "TYPE " + " ".join(types),
        "COUNT " + " ".join("1" for _ in fields),
        f"WIDTH {points}",
        "HEIGHT 1",
        "VIEWPOINT 0.0 0.0 0.0 1.0 0.0 0.0 0.0",
        f"POINTS {points}",
        f"DATA {encoding}",
    ]
    return ("\n".join(lines) + "\n").encode("ascii")


def radar_pcd(
    points: Array,  # [n, 7] float32 in the order of RADAR_FIELDS
) -> bytes:
    """A binary radar file: the real header, then n * 28 bytes."""
    return _header(RADAR_FIELDS, [4] * 7, ["F"] * 7, len(points), "binary") + points.astype("<f4").tobytes()


def lidar_pcd(
    points: Array,  # [n] of LIDAR_TYPE
) -> bytes:
    """A binary_compressed lidar file: fields one after another, packed as LZF.

    Only literal runs are written: valid LZF for every reader, 3 % larger than the data and quick without a compressor.
    """
    sizes = [LIDAR_TYPE[name].itemsize for name in LIDAR_TYPE.names]
    plain = b"".join(np.ascontiguousarray(points[name]).tobytes() for name in LIDAR_TYPE.names)
    full = len(plain) // 32
    runs = np.full((full, 33), 31, dtype=np.uint8)  # a run's length less one, then the run
    runs[:, 1:] = np.frombuffer(plain, np.uint8, 32 * full).reshape(full, 32)
    last = plain[32 * full :]
    packed = runs.tobytes() + (bytes([len(last) - 1]) + last if last else b"")
    header = _header(LIDAR_TYPE.names, sizes, ["F", "F", "F", "F", "U"], len(points), "binary_compressed")
    return header + struct.pack("<II", len(packed), len(plain)) + packed
