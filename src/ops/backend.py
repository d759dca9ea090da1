"""Which implementation of each operation runs, chosen once per process."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

REFERENCE = "reference"

_implementations: dict[str, dict[str, Callable[..., Any]]] = {}
_chosen = REFERENCE


def register(operation: str, backend: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorator: make a function the implementation of `operation` in `backend`."""

    def keep(function: Callable[..., Any]) -> Callable[..., Any]:
        _implementations.setdefault(operation, {})[backend] = function
        return function

    return keep


def available() -> tuple[str, ...]:
    """Names of the backends that implement at least one operation."""
    return tuple(sorted({name for table in _implementations.values() for name in table} | {REFERENCE}))


def use(name: str) -> None:
    """Choose the backend of this process; operations it lacks stay with the torch reference.

    Raises ValueError for a name that is not available.
    """
    global _chosen
    if name not in available():
        raise ValueError(f"backend {name!r}: expected one of {', '.join(available())}")
    _chosen = name


def chosen() -> str:
    """Name of the backend in use."""
    return _chosen


def implementation(operation: str) -> Callable[..., Any]:
    """The function that runs `operation` in the chosen backend."""
    table = _implementations[operation]
    return table.get(_chosen, table[REFERENCE])
