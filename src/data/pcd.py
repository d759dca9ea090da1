"""Point files (PCD 0.7): the header is checked before a byte of data is believed."""

from __future__ import annotations

import os
import re
import struct
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import lzf
import numpy as np

from src.data.tables import LAST_TIME_US
from src.errors import DataError
from src.files.whole_read import read_whole

Array = np.ndarray

RADAR_FIELDS = ("x", "y", "z", "vrel_x", "vrel_y", "vrel_z", "rcs")
LIDAR_FIELDS = ("x", "y", "z", "intensity", "timestamp")
MAX_POINTS = 1_000_000
"""More than any sensor gives in one sweep; a larger number is a damaged header."""
MAX_VALUES = 8 * MAX_POINTS
"""Points times fields; what a file may take in memory follows from it."""
MAX_FILE_BYTES = 2**27
MAX_HEADER_BYTES = 4096
LARGEST = {
    RADAR_FIELDS: np.array([1e4, 1e4, 1e4, 1e3, 1e3, 1e3, 1e3], np.float32),
    LIDAR_FIELDS[:4]: np.array([1e4, 1e4, 1e4, 1e6], np.float32),
}
"""Of each field in size, in m, m/s, dB and counts: hundreds of times what a sensor gives, so beyond it is damage."""
_KINDS = {(kind, size): f"<{kind.lower()}{size}" for kind in "IU" for size in "1248"}
_KINDS |= {("F", "4"): "<f4", ("F", "8"): "<f8"}
_DATA_LINE = re.compile(rb"^[ \t]*DATA[ \t][^\n]*\n", re.MULTILINE)
_RADAR_TYPE = np.dtype([(name, "<f4") for name in RADAR_FIELDS])
"""Of a point of usual files, whose data are the array."""


class LidarCloud(NamedTuple):
    """One sweep of one LiDAR."""

    points: Array  # [n, 4] float32: x, y, z (m, sensor frame), intensity as stored
    times_us: Array  # [n] int64, when each point was measured


@dataclass(frozen=True)
class _Layout:
    """What a header says of the data behind it."""

    dtype: np.dtype  # of one point
    count: int  # points
    encoding: str
    start: int  # byte at which the data begin


def read_radar_points(
    path: str | os.PathLike[str],
) -> Array:  # [n, 7] float32 in the order of RADAR_FIELDS, sensor frame
    """Positions (m), relative radial velocity vectors (m/s) and RCS of one radar sweep; a file may hold no point.

    Fields are taken by name, in any order; usual files are one read-only view of their bytes.
    Raises DataError naming the file, what was expected and what was found.
    """
    content = read_whole(path, MAX_FILE_BYTES)
    try:
        layout = _layout(content, RADAR_FIELDS)
        if layout.dtype == _RADAR_TYPE and layout.encoding == "binary":
            points = _table(content, layout).view("<f4").reshape(layout.count, len(RADAR_FIELDS))
        else:
            points = _floats(_columns(content, layout), RADAR_FIELDS)
        _check_range(points, RADAR_FIELDS, "radar")
        return points
    except DataError as error:
        raise DataError(f"{path}: {error}") from error.__cause__


def read_lidar_points(path: str | os.PathLike[str]) -> LidarCloud:
    """Points and their times of one LiDAR sweep; a file may hold no point.

    Points without a return, whose x, y and z are all NaN, are left out. Raises DataError as `read_radar_points`.
    """
    content = read_whole(path, MAX_FILE_BYTES)
    try:
        columns = _columns(content, _layout(content, LIDAR_FIELDS))
        points, times_us = _floats(columns, LIDAR_FIELDS[:4]), _times_us(columns["timestamp"])
        returned = ~np.isnan(points[:, :3]).all(axis=1)
        if not returned.all():
            points, times_us = points[returned], times_us[returned]
        _check_range(points, LIDAR_FIELDS[:4], "lidar")
        return LidarCloud(points, times_us)
    except DataError as error:
        raise DataError(f"{path}: {error}") from error.__cause__


def _check_range(points: Array, fields: tuple[str, ...], sensor: str) -> None:
    limits = LARGEST[fields]
    possible = np.abs(points) <= limits  # False for NaN too
    if not possible.all():
        row = int(np.argmin(possible.all(axis=1)))
        finite = np.isfinite(points[row]).all()
        fault = f"is beyond {limits.tolist()}, more than any {sensor} gives" if finite else "is not finite"
        raise DataError(f"point {row} {fault}: {points[row].tolist()}")


def _times_us(stamps: Array) -> Array:  # [n] int64
    """Raises DataError for a time that is none of the Unix epoch in microseconds."""
    known = (stamps >= 1) & (stamps < LAST_TIME_US)  # False for NaN too
    if not known.all():
        row = int(np.argmin(known))
        raise DataError(f"point {row} has the timestamp {stamps[row]}, expected microseconds since 1970")
    return stamps.astype(np.int64)


def _columns(content: bytes, layout: _Layout) -> dict[str, Array]:  # [n] each
    if layout.encoding == "ascii":
        table = _ascii_table(content[layout.start :], layout.dtype.names, layout.count)
        return dict(zip(layout.dtype.names, table.T, strict=True))
    if layout.encoding == "binary":
        table = _table(content, layout)
        return {name: table[name] for name in layout.dtype.names}
    data, columns, at = _decompressed(content, layout), {}, 0
    for name in layout.dtype.names:  # one field after another
        columns[name] = np.frombuffer(data, layout.dtype[name], layout.count, at)
        at += columns[name].nbytes
    return columns


def _table(content: bytes, layout: _Layout) -> Array:  # [n] of layout.dtype
    expected = layout.start + layout.count * layout.dtype.itemsize
    if len(content) != expected:
        raise DataError(f"{layout.count} points end at byte {expected}, but the file has {len(content)} bytes")
    return np.frombuffer(content, layout.dtype, layout.count, layout.start)


def _decompressed(content: bytes, layout: _Layout) -> bytes:
    """The data of an LZF file; never more than the points that its header states."""
    start, size = layout.start + 8, layout.count * layout.dtype.itemsize
    if len(content) < start:
        raise DataError(f"the sizes of compressed data end at byte {start}, but the file has {len(content)} bytes")
    packed, unpacked = struct.unpack_from("<II", content, layout.start)
    if unpacked != size:
        raise DataError(f"{layout.count} points are {size} bytes, but {unpacked} compressed ones are stated")
    if len(content) != start + packed:
        raise DataError(f"the compressed data end at byte {start + packed}, but the file has {len(content)} bytes")
    if not size:
        return b""
    try:
        data = lzf.decompress(content[start:], size)
    except ValueError as error:
        raise DataError(f"the compressed data are damaged ({error})") from error
    if data is None or len(data) != size:
        found = "more" if data is None else len(data)
        raise DataError(f"the compressed data are damaged: {size} bytes expected, but {found} found")
    return data


def _layout(content: bytes, wanted: tuple[str, ...]) -> _Layout:
    """The header's meaning; files differ in little but their number of points, so most headers were met before."""
    line = _DATA_LINE.search(content, 0, MAX_HEADER_BYTES)
    if line is None:
        raise DataError(f"not a PCD file: no DATA line in the first {min(len(content), MAX_HEADER_BYTES)} bytes")
    return _known_layout(content[: line.end()], wanted)


@lru_cache(maxsize=2048)  # about a kilobyte each
def _known_layout(content: bytes, wanted: tuple[str, ...]) -> _Layout:
    lines = [line.split() for line in content.decode("ascii", "replace").split("\n")]
    header = {words[0]: words[1:] for words in lines if words and not words[0].startswith("#")}
    names, kinds = _types(header)
    count = _count(header)
    missing = [name for name in wanted if name not in names]
    if missing:
        sensor = "radar" if wanted == RADAR_FIELDS else "lidar"
        raise DataError(f"a {sensor} file has the fields {list(wanted)}, but {missing} are not in {names}")
    encoding = " ".join(header["DATA"][:1])
    if encoding not in ("binary", "ascii", "binary_compressed"):
        raise DataError(f"DATA must be binary, ascii or binary_compressed, but got {encoding!r}")
    if count * len(names) > MAX_VALUES:
        raise DataError(f"at most {MAX_VALUES} numbers are expected, but got {count} points of {len(names)} fields")
    return _Layout(np.dtype(list(zip(names, kinds, strict=True))), count, encoding, len(content))


def _types(header: dict[str, list[str]]) -> tuple[list[str], list[str]]:
    names, sizes, types = (header.get(key, []) for key in ("FIELDS", "SIZE", "TYPE"))
    counts = header.get("COUNT", ["1"] * len(names))
    if not names or len(set(names)) != len(names) or not len(names) == len(sizes) == len(types) == len(counts):
        lines = f"{names}, {sizes}, {types}, {counts}"
        raise DataError(f"FIELDS, SIZE, TYPE and COUNT must have one entry per field, but got {lines}")
    if set(counts) != {"1"}:
        raise DataError(f"every field must have COUNT 1, but got {counts}")
    kinds = [_KINDS.get((kind, size)) for kind, size in zip(types, sizes, strict=True)]
    if None in kinds:
        at = kinds.index(None)
        raise DataError(f"field {names[at]} has TYPE {types[at]} SIZE {sizes[at]}, which is not supported")
    return names, kinds


def _count(header: dict[str, list[str]]) -> int:
    numbers = {}
    for key in ("WIDTH", "HEIGHT", "POINTS"):
        words = header.get(key, [])
        if len(words) != 1 or not words[0].isdigit() or len(words[0]) > 18:
            raise DataError(f"{key} must be one whole number, but got {words}")
        numbers[key] = int(words[0])
    if numbers["POINTS"] > MAX_POINTS or numbers["WIDTH"] * numbers["HEIGHT"] != numbers["POINTS"]:
        raise DataError(f"WIDTH x HEIGHT must equal POINTS, at most {MAX_POINTS}, but got {numbers}")
    return numbers["POINTS"]


def _ascii_table(text: bytes, names: tuple[str, ...], count: int) -> Array:  # [n, F] float64
    expected = count * len(names)
    words = text.split(maxsplit=expected)  # and what is left over as one more
    if len(words) != expected:
        found = f"only {len(words)} numbers" if len(words) < expected else "more numbers"
        raise DataError(f"{count} points of {len(names)} fields expected, but {found} found")
    try:
        return np.array(words, dtype=np.float64).reshape(count, len(names))
    except ValueError as error:
        raise DataError(f"not a number in the data ({error})") from error


def _floats(columns: dict[str, Array], names: tuple[str, ...]) -> Array:  # [n, F] float32, infinite beyond its range
    with np.errstate(over="ignore", invalid="ignore"):
        return np.stack([columns[name].astype(np.float32) for name in names], axis=1)
