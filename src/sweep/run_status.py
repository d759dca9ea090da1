"""State of a run by its folder: whether it is finished, its scores, and whether a process trains in it."""

from __future__ import annotations

import csv
import fcntl
import json
from pathlib import Path
from typing import Any

from src.report.results import is_finished
from src.report.run_curves import read_curves

LARGEST = 1e9
"""Largest size of a score: a number beyond it, or one that is not finite, is damage."""


def is_finished_with_score(folder: Path) -> bool:
    """Whether the run is finished and its headline number can be read."""
    return is_finished(folder) and read_score(folder, read_headline(folder)) is not None


def read_headline(folder: Path) -> str:
    """Name of the task's main number in metrics.json; detection's where run.json does not say."""
    name = _read(folder / "run.json", "headline")
    return name if isinstance(name, str) else "mAP"


def read_score(folder: Path, metric: str) -> float | None:
    """One number of metrics.json by its dotted name, None where it is not there or not finite."""
    value = _read(folder / "metrics.json", metric)
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if is_number and abs(value) <= LARGEST else None


def _read(path: Path, name: str) -> Any:
    try:
        return _find(json.loads(path.read_text()), name)
    except (OSError, ValueError, RecursionError):
        return None


def _find(node: Any, name: str) -> Any:
    """Follow a dotted name through nested objects: keys such as `0-0.5` hold dots, and names leave `classes` out."""
    if not isinstance(node, dict):
        return None
    if name in node:
        return node[name]
    for key in node:
        if name.startswith(f"{key}."):
            return _find(node[key], name.removeprefix(f"{key}."))
    return _find(node.get("classes"), name)


def is_locked(folder: Path) -> bool:
    """Whether a process is training in the folder (it holds `.lock`)."""
    try:
        with (folder / ".lock").open() as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


def read_validations(folder: Path, metric: str) -> dict[int, float]:
    """Validated values of a metric so far by epoch, from metrics.csv."""
    try:
        return dict(read_curves(folder / "metrics.csv", live=True, over="epoch").get(f"val/{metric}", []))
    except (OSError, ValueError, csv.Error):
        return {}
