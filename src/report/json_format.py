"""JSON that anybody may have written, read as the dataclass or TypedDict that declares its format (pydantic)."""

from __future__ import annotations

import difflib
import functools
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic_core import from_json

from src.errors import DataError

Format = TypeVar("Format")
Item = TypeVar("Item")

MAX_BYTES = 16_000_000
"""Largest file that is read; real ones have a tenth. A wrong value in a dict costs a kilobyte while it is refused."""
MAX_FAULTS = 1000
"""More wrong values than these are only counted."""

CLOSED = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)
"""Exactly these keys, of exactly these types: 1 and "1" are not the same, NaN is no number."""
OPEN = ConfigDict(strict=True, allow_inf_nan=False)
"""As CLOSED, but other keys are left out."""
ANY_KEYS = OPEN | {"extra": "allow"}
"""As CLOSED, but other keys are kept as they are."""

Many = Annotated[list[Item], Field(fail_fast=True)]
"""A list that is refused at its first wrong item, as it may hold millions of them."""
Count = Annotated[int, Field(ge=0, le=10**15)]
Measure = Annotated[float, Field(ge=-1e15, le=1e15)]
"""Beyond 1e15 is damage, not a measurement."""


def read_json(path: Path, remedy: str) -> bytes:
    """The bytes of a file that holds JSON (at most 200 levels deep). Raises DataError naming it."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise ValueError(f"at most {MAX_BYTES} bytes are expected, but it has {path.stat().st_size}")
        content = path.read_bytes()
        from_json(content)
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: not readable as JSON ({error}); {remedy}") from error
    return content


def parse_as(kind: type[Format], content: bytes | str, known: Collection[str] = ()) -> Format:
    """JSON as `kind`. Raises ValueError naming the first wrong value: what is expected and what was found.

    `known` are keys that a wrong one may have been meant as.
    """
    try:
        return _adapter(kind).validate_json(content)
    except ValidationError as error:
        raise ValueError(_first_fault(error, known)) from None


def read_as(kind: type[Format], path: Path, remedy: str) -> Format:
    """A JSON file as `kind`. Raises DataError naming the file, the first wrong value and the remedy."""
    content = read_json(path, remedy)
    try:
        return parse_as(kind, content)
    except ValueError as error:
        raise DataError(f"{path}: {error}; {remedy}") from error


def read_all(
    folder: Path, read: Callable[[Path], Item], pattern: str = "*.json"
) -> tuple[list[Item], dict[Path, DataError]]:
    """What `read` makes of each file of a folder, by name, and what could not be read, by file."""
    found, broken = [], {}
    for path in sorted(folder.glob(pattern)):
        try:
            found.append(read(path))
        except DataError as error:
            broken[path] = error
    return found, broken


@functools.cache
def _adapter(kind: type[Format]) -> TypeAdapter[Format]:
    return TypeAdapter(kind)


def _first_fault(error: ValidationError, known: Collection[str]) -> str:
    if error.error_count() > MAX_FAULTS:
        return f"{error.error_count()} values are wrong"
    faults: list[Any] = error.errors(include_url=False, include_context=False)
    first = min(faults, key=lambda fault: fault["loc"] != ("format",))  # another format explains all other faults
    keys = [str(key) for key in first["loc"] if key != "[key]"]
    name = ".".join(keys) or "the file"
    if first["type"] == "missing":
        return f"{name} is missing"
    if first["type"] == "unexpected_keyword_argument":
        near = difflib.get_close_matches(keys[-1], known, n=1)
        return f"{name} is not a known key" + (f"; did you mean {near[0]}?" if near else "")
    return f"{name} {first['msg'].replace('Input should', 'must', 1)}, but is {first['input']!r:.80}"
