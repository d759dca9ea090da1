"""Finished runs as they lie on disk, checked when read. Imports nothing of the rest, and never torch."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from src.errors import DataError

NOT_A_SETTING = ("seed=", "paths.", "trainer", "logger", "resume=", "data.num_workers=", "data.root=")
"""Overrides that do not make another experiment."""


@dataclass
class RunResult:
    """One finished run: its record (run.json) and its numbers (metrics.json)."""

    run_id: str
    settings: tuple[str, ...]  # overrides that define the experiment, sorted
    seed: int
    scale: str
    data: str  # name of the data and digest of the world, what must agree within a table
    seconds: float
    peak_memory_mib: int
    parameters: int
    metrics: dict[str, Any]


def read_runs(outputs: Path, scale: str, phase: str) -> list[RunResult]:
    """All finished runs of one scale and phase under `outputs`, by name, without those that a restart moved aside.

    Raises DataError naming file and key for a record that cannot be read.
    """
    results = []
    for record_path in sorted(outputs.glob("*/run.json")):
        metrics_path = record_path.with_name("metrics.json")
        if not metrics_path.is_file() or ".before-" in record_path.parent.name:  # unfinished, or replaced by a restart
            continue
        record, metrics = _read(record_path), _read(metrics_path)
        try:
            if record["scale"] != scale or f"-{phase}-" not in record["run_id"]:
                continue
            settings = sorted(o for o in record["overrides"] if not o.startswith((*NOT_A_SETTING, "phase=", "scale=")))
            results.append(
                RunResult(
                    run_id=record["run_id"],
                    settings=tuple(settings),
                    seed=int(record["seed"]),
                    scale=record["scale"],
                    data=f"{record['data']['name']} {record['data']['root']}",
                    seconds=float(record["seconds"]["all"]),
                    peak_memory_mib=int(record["peak_memory_mib"]["process"]),
                    parameters=int(record["parameters"]),
                    metrics=_checked(metrics),
                )
            )
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(
                f"{record_path.parent}: run.json or metrics.json is not as a run writes them ({type(error).__name__}: "
                f"{error}); delete both and give the run's command again"
            ) from error
    return results


def _checked(metrics: dict[str, Any]) -> dict[str, Any]:
    """What the tables read; raises KeyError, TypeError or ValueError for what is missing or no number."""
    values = {name: metrics[name] for name in ("mAP", "NDS")}
    values |= {f"classes.{name}.AP": scores["AP"] for name, scores in metrics["classes"].items()}
    values |= {f"ranges.{name}.mAP": scores["mAP"] for name, scores in metrics["ranges"].items()}
    for name, value in values.items():
        if type(value) not in (int, float):
            raise ValueError(f"{name} must be a number, but is {value!r}")
    return {key: metrics[key] for key in ("mAP", "NDS", "classes", "ranges")}


def _read(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: not readable as JSON ({error}); retrain that run with resume=restart") from error
    if not isinstance(content, dict):
        raise DataError(f"{path}: must hold an object, but holds a {type(content).__name__}")
    return content
