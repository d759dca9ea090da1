"""One TruckScenes JSON table as checked columns; every complaint names table, record, value and remedy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic_core import from_json

from src.errors import DataError
from src.files.whole_read import read_whole

Array = np.ndarray

MAX_TEXT = 255
"""Characters of a token, a name or a path: arrays of them take the length of the longest for each record."""
MAX_DESCRIPTION = 10_000
MAX_TABLE_BYTES = 2**36
"""64 GiB; the largest real table has a few."""
LARGEST = 1e8
"""Of any number in size, mostly metres: beyond every place on Earth in every map projection."""
LAST_TIME_US = 10**16
"""Three hundred years after 1970."""

_REMEDY = "restore the file from the data set's archive, or write the synthetic world again"


class Table:
    """The records of one table, addressed by column; none of one that is not `wanted`, which is not opened.

    Raises DataError when the file is missing (an `optional` one then has no records), is not JSON (with line and
    column), is not a list of records, or when a token is missing, empty or used twice.
    """

    def __init__(self, path: Path, optional: bool = False, wanted: bool = True) -> None:
        self.path = path
        self.name = path.stem
        self.records: list[dict[str, Any]] = []
        if wanted and (not optional or path.exists()):
            self.records = _read_list(path)
        self.tokens: list[str] = self.values("token")
        self.rows = {token: row for row, token in enumerate(self.tokens)}
        if len(self.rows) != len(self.tokens):
            row = next(row for row, token in enumerate(self.tokens) if self.rows[token] != row)
            twin = self.rows[self.tokens[row]]
            self.fail(row, "token", self.tokens[row], f"a token of its own (record {twin} has it too)")
        if "" in self.rows:
            self.fail(self.rows[""], "token", "", "a token that is not empty")

    def __len__(self) -> int:
        return len(self.records)

    def fail(self, row: int, field: str, value: object, expected: str) -> None:
        """Raise a DataError about one value of one record."""
        where = f"{self.path}: {self.name} {_short(self.records[row].get('token', ''))} (record {row})"
        raise DataError(f"{where}: {field}={_short(value)}, expected {expected}; {_REMEDY}")

    def check(self, good: Array, field: str, values: Sequence[object] | Array, expected: str) -> None:
        """Raise about the first record for which `good` [n] is False."""
        if not np.all(good):
            row = int(np.argmin(good))
            value = values[row]
            self.fail(row, field, value.tolist() if isinstance(value, np.ndarray | np.generic) else value, expected)

    def values(self, field: str, kind: type = str, most: int = MAX_TEXT) -> list[Any]:
        """One field of every record, all of type `kind`; a text of at most `most` characters."""
        try:
            column = [record[field] for record in self.records]
        except KeyError:
            row = next(row for row, record in enumerate(self.records) if field not in record)
            token = _short(self.records[row].get("token", ""))
            raise DataError(
                f"{self.path}: {self.name} {token} (record {row}) has no field '{field}', "
                f"but only {_short(sorted(self.records[row]))}; {_REMEDY}"
            ) from None
        if any(type(value) is not kind for value in column):
            row = _first(column, lambda value: type(value) is not kind)
            self.fail(row, field, column[row], f"a value of type {kind.__name__}")
        if kind is str and (max(map(len, column), default=0) > most or "\0" in "".join(column)):
            row = _first(column, lambda value: len(value) > most or "\0" in value)
            self.fail(row, field, column[row], f"a text of at most {most} characters, without NUL")
        return column

    def integers(self, field: str) -> Array:  # [n] int64
        """An integer field."""
        column = self.values(field, int)
        fits = np.array([-(2**63) <= value < 2**63 for value in column], bool)
        self.check(fits, field, column, "an integer of at most 64 bits")
        return np.array(column, np.int64)

    def times(self) -> Array:  # [n] int64, microseconds
        """The time stamps."""
        stamps = self.integers("timestamp")
        possible = (stamps > 0) & (stamps < LAST_TIME_US)
        self.check(possible, "timestamp", stamps, f"microseconds since 1970, above 0 and below {LAST_TIME_US}")
        return stamps

    def vectors(self, field: str, width: int, finite: bool = True) -> Array:  # [n, width] float64
        """A list of `width` numbers per record; unless `finite` is False none is NaN or beyond LARGEST in size."""
        return self._numbers(self.values(field, list), field, (width,), finite=finite)

    def rotations(self) -> Array:  # [n, 4] float64 (w, x, y, z)
        """The field `rotation`; a length more than 1e-3 away from 1 is refused, smaller rounding stays."""
        raw = self.vectors("rotation", 4)
        length = np.linalg.norm(raw, axis=1)
        self.check(np.abs(length - 1) < 1e-3, "rotation", raw, "a quaternion (w, x, y, z) of length 1")
        return raw

    def intrinsics(self, needed: Array) -> Array:  # [n, 3, 3] float64, NaN where not needed
        """Camera matrices (`camera_intrinsic`) of the records marked in `needed` [n]."""
        field = "camera_intrinsic"
        column = self.values(field, list)
        result = np.full((len(column), 3, 3), np.nan)
        for row in np.flatnonzero(needed):
            matrix = self._numbers([column[row]], field, (3, 3), int(row))[0]
            if not (matrix[0, 0] > 0 and matrix[1, 1] > 0 and np.array_equal(matrix[2], [0, 0, 1])):
                expected = "an invertible 3x3 with positive focal lengths and last row 0, 0, 1"
                self.fail(int(row), field, column[row], expected)
            result[row] = matrix
        return result

    def links(self, field: str, other: Table, optional: bool = False) -> Array:  # [n] int64, -1 where ""
        """Rows in `other` that a token field points to."""
        return self.lookup(self.values(field), field, other, optional)

    def chain(self, field: str, times: Array, owners: Array, owner: str) -> Array:  # [n] int64, -1 where ""
        """Rows of this table that a field links records to, of the same owner and before them in `times` [n]."""
        links, values = self.links(field, self, optional=True), self.values(field)
        self.check((links < 0) | (owners[links] == owners), field, values, f"a record of the same {owner}")
        order = "earlier" if field == "prev" else "later"
        self.check((links < 0) | (times[links] < times), field, values, f"a record that is {order}")
        return links

    def lookup(self, tokens: list[str], field: str, other: Table, optional: bool = False) -> Array:  # [n] int64
        """Rows in `other` of one token per record."""
        rows = np.array([other.rows.get(token, -2 if token else -1) for token in tokens], np.int64)
        self.check(rows >= (-1 if optional else 0), field, tokens, f"a token of the table {other.name}")
        return rows

    def _numbers(
        self, column: list[Any], field: str, shape: tuple[int, ...], first_row: int = 0, finite: bool = True
    ) -> Array:
        """Numbers of one shape per record, float64, of at most LARGEST in size unless `finite` is False."""
        try:
            raw = np.array(column) if column else np.zeros((0, *shape))
        except ValueError:  # ragged
            raw = np.zeros(0, object)
        if raw.shape != (len(column), *shape) or raw.dtype.kind not in "if":
            row = _first(column, lambda value: not _is_numeric(value, shape))
            self.fail(first_row + row, field, column[row], f"{'x'.join(map(str, shape))} numbers")
        result = raw.astype(np.float64)
        good = (np.abs(result) <= LARGEST).all(axis=tuple(range(1, result.ndim)))  # False for NaN too
        if finite and not good.all():
            row = int(np.argmin(good))
            self.fail(first_row + row, field, column[row], f"finite numbers of at most {LARGEST:g} in size")
        return result


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 120 else text[:117] + "..."


def _first(column: list[Any], bad: Callable[[Any], bool]) -> int:
    return next((row for row, value in enumerate(column) if bad(value)), 0)


def _is_numeric(value: object, shape: tuple[int, ...]) -> bool:
    try:
        array = np.array(value)
    except ValueError:
        return False
    return array.shape == shape and array.dtype.kind in "if"


def _read_list(path: Path) -> list[dict[str, Any]]:
    if not path.exists():
        raise DataError(f"{path}: this table is missing; {_REMEDY}")
    try:
        records = from_json(read_whole(path, MAX_TABLE_BYTES))
    except ValueError as error:  # with line and column
        raise DataError(f"{path}: not a table of JSON ({error}); {_REMEDY}") from None
    if not isinstance(records, list):
        raise DataError(f"{path}: expected a list of records, but got {type(records).__name__}; {_REMEDY}")
    for row, record in enumerate(records):
        if not isinstance(record, dict):
            raise DataError(f"{path}: record {row} must be an object, but got {type(record).__name__}; {_REMEDY}")
    return records
