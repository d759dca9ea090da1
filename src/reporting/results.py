"""Finished runs as they lie on disk, checked when read. Imports nothing of the rest, and never torch."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from src.errors import DataError

NOT_A_SETTING = (
    "seed=", "scale=", "phase=", "paths.", "trainer", "logger", "resume=", "data.num_workers=", "data.root=",
    "phase.train_missing=",
)  # fmt: skip
"""Overrides that do not make another experiment."""


@dataclass
class RunResult:
    """One finished run: its record (run.json) and its numbers (metrics.json)."""

    run_id: str
    phase: str
    settings: tuple[str, ...]  # overrides that define the experiment within its phase, sorted
    seed: int
    scale: str
    data: str  # name of the data and digest of the world, what must agree within a table
    epochs: int  # of this phase
    seconds: float
    peak_memory_mib: int
    parameters: int
    metrics: dict[str, float | None]
    """By path within metrics.json: mAP, NDS, mAVE, classes.<class>.AP, ranges.<bin>.mAP and, where the run was scored
    by speed class, speeds.<class>.<mAP_present | mAVE_present | car.AP | car.AVE> (None where there is no such ground
    truth) and speeds.<class>.<boxes | car.boxes>, how much ground truth there is."""


def read_runs(outputs: Path, scale: str, phases: Sequence[str]) -> list[RunResult]:
    """All finished runs of one scale and these phases under `outputs`, by name, without those a restart moved aside.

    Raises DataError naming file and key for a record that cannot be read.
    """
    results = []
    for record_path in sorted(outputs.glob("*/run.json")):
        metrics_path = record_path.with_name("metrics.json")
        if not metrics_path.is_file() or ".before-" in record_path.parent.name:  # unfinished, or replaced by a restart
            continue
        record = _Record(record_path)
        run_id = record.get("run_id", str)
        phase = next((phase for phase in phases if f"-{phase}-" in run_id), None)
        if record.get("scale", str) != scale or phase is None:
            continue
        settings = sorted(o for o in record.get("overrides", list) if not o.startswith(NOT_A_SETTING))
        results.append(
            RunResult(
                run_id=run_id,
                phase=phase,
                settings=tuple(settings),
                seed=record.get("seed", int),
                scale=scale,
                data=f"{record.get(('data', 'name'), str)} {record.get(('data', 'root'), str)}",
                epochs=record.get("epochs", int),
                seconds=record.get(("seconds", "all"), float, int),
                peak_memory_mib=record.get(("peak_memory_mib", "process"), int),
                parameters=record.get("parameters", int),
                metrics=_metrics(_Record(metrics_path)),
            )
        )
    return results


def _metrics(content: _Record) -> dict[str, float | None]:
    paths = [("mAP",), ("NDS",), ("mAVE",)]
    paths += [("classes", name, "AP") for name in content.get("classes", dict)]
    paths += [("ranges", name, "mAP") for name in content.get("ranges", dict)]
    values = {".".join(path): content.get(path, float, int) for path in paths}
    if "speeds" not in content.content:  # written before there were speed classes
        return values
    for name in content.get("speeds", dict):
        for key in ("mAP_present", "mAVE_present"):
            values[f"speeds.{name}.{key}"] = content.get(("speeds", name, key), float, int, type(None))
        classes = ("speeds", name, "classes")
        boxes = [content.get((*classes, of, "num_gt"), int) for of in content.get(classes, dict)]
        cars = content.get((*classes, "car", "num_gt"), int)
        values |= {f"speeds.{name}.boxes": sum(boxes), f"speeds.{name}.car.boxes": cars}
        for key in ("AP", "AVE"):  # the official numbers of a class without ground truth are 0 and 1, and say nothing
            value = content.get((*classes, "car", key), float, int)
            values[f"speeds.{name}.car.{key}"] = value if cars else None
    return values


class _Record:
    """A JSON file of a run; whatever it lacks is named with the file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self.content = json.loads(path.read_text())
        except (OSError, ValueError) as error:
            raise DataError(f"{path}: not readable as JSON ({error}); retrain that run with resume=restart") from error
        if not isinstance(self.content, dict):
            raise DataError(f"{path}: must hold an object, but holds a {type(self.content).__name__}")

    def get(self, names: str | Sequence[str], *kinds: type) -> Any:
        """The value at one name, or under several names one inside the other; its type is exactly one of `kinds`."""
        names = (names,) if isinstance(names, str) else names
        value: Any = self.content
        for depth, name in enumerate(names):
            if not isinstance(value, dict) or name not in value:
                raise self._refusal(names[: depth + 1], "is missing")
            value = value[name]
        if type(value) not in kinds:
            expected = " or ".join("null" if kind is type(None) else kind.__name__ for kind in kinds)
            raise self._refusal(names, f"must be {expected}, but is {value!r:.80}")
        return value

    def _refusal(self, names: Sequence[str], fault: str) -> DataError:
        return DataError(
            f"{self.path}: {'.'.join(names)} {fault}; delete run.json and metrics.json there and give the run's "
            "command again"
        )
