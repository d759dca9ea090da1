"""Point files (PCD 0.7): the header is checked before a byte of data is believed."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from src.data.files import read_whole
from src.errors import DataError

Array = np.ndarray

RADAR_FIELDS = ("x", "y", "z", "vrel_x", "vrel_y", "vrel_z", "rcs")
MAX_POINTS = 1_000_000
"""More than any sensor gives in one sweep; a larger number is a damaged header."""
MAX_VALUES = 8 * MAX_POINTS
"""Points times fields; what a file may take in memory follows from it."""
MAX_FILE_BYTES = 2**27
MAX_HEADER_BYTES = 4096
LARGEST = np.array([1e4, 1e4, 1e4, 1e3, 1e3, 1e3, 1e3], np.float32)
"""Of each of RADAR_FIELDS in size, in m, m/s and dB: hundreds of times what a radar gives, so beyond it is damage."""
_KINDS = {(kind, size): f"<{kind.lower()}{size}" for kind in "IU" for size in "1248"}
_KINDS |= {("F", "4"): "<f4", ("F", "8"): "<f8"}


@dataclass(frozen=True)
class _Layout:
    """What a header says of the data behind it."""

    fields: tuple[str, ...]
    dtype: np.dtype  # of one point
    count: int  # points
    encoding: str
    start: int  # byte at which the data begin
    plain: bool  # nothing but RADAR_FIELDS as float32 in their order: the data are the array


def read_radar_points(
    path: str | os.PathLike[str],
) -> Array:  # [n, 7] float32 in the order of RADAR_FIELDS, sensor frame
    """Positions (m), relative radial velocity vectors (m/s) and RCS of one radar sweep; a file may hold no point.

    Fields are taken by name, in any order, from `binary` or `ascii` data; usual files are one read-only view of their
    bytes. Raises DataError naming the file, what was expected and what was found.
    """
    content = read_whole(path, MAX_FILE_BYTES)
    try:
        layout = _layout(content)
        points = _points(content, layout)
    except DataError as error:
        raise DataError(f"{path}: {error}") from error.__cause__
    possible = np.abs(points) <= LARGEST  # False for NaN too
    if not possible.all():
        row = int(np.argmin(possible.all(axis=1)))
        finite = np.isfinite(points[row]).all()
        fault = f"is beyond {LARGEST.tolist()}, more than any radar gives" if finite else "is not finite"
        raise DataError(f"{path}: point {row} {fault}: {points[row].tolist()}")
    return points


def _points(content: bytes, layout: _Layout) -> Array:  # [n, 7] float32
    if layout.encoding == "ascii":
        return _ascii_points(content[layout.start :], layout.fields, layout.count)
    expected = layout.start + layout.count * layout.dtype.itemsize
    if len(content) != expected:
        raise DataError(f"{layout.count} points end at byte {expected}, but the file has {len(content)} bytes")
    if layout.plain:
        return np.frombuffer(content, "<f4", offset=layout.start).reshape(layout.count, len(RADAR_FIELDS))
    table = np.frombuffer(content, layout.dtype, layout.count, layout.start)
    return _as_float32(np.stack([table[name] for name in RADAR_FIELDS], axis=1))


def _layout(content: bytes) -> _Layout:
    """The header's meaning; files differ in little but their number of points, so most headers were met before."""
    data = content.find(b"\nDATA ", 0, MAX_HEADER_BYTES)
    end = content.find(b"\n", data + 1, MAX_HEADER_BYTES) + 1 if data >= 0 else 0
    return _known_layout(content[:end]) if end else _parse_layout(content)


def _parse_layout(content: bytes) -> _Layout:
    header, start = _header(content)
    names, kinds = _columns(header)
    count = _count(header)
    missing = [name for name in RADAR_FIELDS if name not in names]
    if missing:
        raise DataError(f"a radar file has the fields {list(RADAR_FIELDS)}, but {missing} are not in {names}")
    encoding = header.get("DATA", [""])[0]
    if encoding not in ("binary", "ascii"):
        raise DataError(f"DATA must be binary or ascii for a radar file, but got {encoding!r}")
    if count * len(names) > MAX_VALUES:
        raise DataError(f"at most {MAX_VALUES} numbers are expected, but got {count} points of {len(names)} fields")
    dtype = np.dtype(list(zip(names, kinds, strict=True)))
    plain = names == list(RADAR_FIELDS) and set(kinds) == {"<f4"}
    return _Layout(tuple(names), dtype, count, encoding, start, plain)


_known_layout = lru_cache(maxsize=2048)(_parse_layout)  # about a kilobyte each


def _header(content: bytes) -> tuple[dict[str, list[str]], int]:
    """Header entries, and the byte at which the data begin."""
    entries: dict[str, list[str]] = {}
    at = 0
    while at < min(len(content), MAX_HEADER_BYTES):
        end = content.find(b"\n", at, MAX_HEADER_BYTES)
        if end < 0:
            break
        words = content[at:end].decode("ascii", "replace").split()
        at = end + 1
        if words and not words[0].startswith("#"):
            entries[words[0]] = words[1:]
            if words[0] == "DATA":
                return entries, at
    raise DataError(f"not a PCD file: no DATA line in the first {min(len(content), MAX_HEADER_BYTES)} bytes")


def _columns(header: dict[str, list[str]]) -> tuple[list[str], list[str]]:
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


def _ascii_points(text: bytes, names: tuple[str, ...], count: int) -> Array:
    expected = count * len(names)
    words = text.split(maxsplit=expected)  # and what is left over as one more
    if len(words) != expected:
        found = f"only {len(words)} numbers" if len(words) < expected else "more numbers"
        raise DataError(f"{count} points of {len(names)} fields expected, but {found} found")
    try:
        table = np.array(words, dtype=np.float64).reshape(count, len(names))
    except ValueError as error:
        raise DataError(f"not a number in the data ({error})") from error
    return _as_float32(table[:, [names.index(name) for name in RADAR_FIELDS]])


def _as_float32(
    values: Array,  # [n, 7] numbers of any type
) -> Array:  # [n, 7] float32, infinite beyond its range
    with np.errstate(over="ignore", invalid="ignore"):
        return values.astype(np.float32)
