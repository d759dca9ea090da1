"""Learning curves in a run's metrics.csv. Never torch."""

from __future__ import annotations

import csv
from pathlib import Path

from src.errors import DataError

MAX_POINTS = 200
"""Most points of a learning curve."""
LARGEST_POINT = 1e15
"""Points with a larger number are left out of a learning curve."""

Point = tuple[int, float]  # step, value


def curves_of(path: Path) -> dict[str, list[Point]]:
    """Learning curves of a run that has ended (`read_curves`); none without the file. Raises DataError naming it."""
    try:
        return read_curves(path) if path.is_file() else {}
    except (OSError, ValueError, TypeError, csv.Error) as error:
        raise DataError(f"{path}: not a run's learning curves ({type(error).__name__}: {error}); delete it") from error


def read_curves(path: Path, live: bool = False, over: str = "step") -> dict[str, list[Point]]:
    """The losses and validation scores of metrics.csv, thinned out evenly to at most MAX_POINTS each.

    Of a run that still trains (`live`) also the loss by step; a line may be half written, and what is no number is left
    out. Else it raises ValueError or TypeError.
    """
    columns = ("loss/", "val/", *(["step/total"] if live else []))
    curves: dict[str, list[Point]] = {}
    with path.open(newline="") as file:
        for row in csv.DictReader(file):
            for name, text in row.items():
                if not (name and text and name.startswith(columns)):
                    continue
                try:
                    step, value = int(row.get(over)), float(text)
                except (ValueError, TypeError):
                    if live:
                        continue
                    raise
                if abs(step) <= LARGEST_POINT and abs(value) <= LARGEST_POINT:
                    curves.setdefault(name, []).append((step, value))
    return {name: _thinned(points) for name, points in sorted(curves.items())}


def _thinned(points: list[Point]) -> list[Point]:
    """At most MAX_POINTS of the points, spread evenly, the first and the last among them."""
    last = len(points) - 1
    if last < MAX_POINTS:
        return points
    return [points[round(index * last / (MAX_POINTS - 1))] for index in range(MAX_POINTS)]
