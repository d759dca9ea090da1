"""Finished runs as `reports/results/<run_id>.json`: written from a run's folder, checked when read. Never torch."""

from __future__ import annotations

import csv
import hashlib
import json
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import yaml

from src.errors import DataError
from src.report.atomic_write import write_whole
from src.report.json_object import LARGEST, NONE, NUMBER, JsonObject
from src.report.metric_names import METRICS
from src.report.plain_yaml import load_plain_yaml
from src.training.identity import OUTSIDE_IDENTITY, is_of, key_of, without_keys

FORMAT = 1
RUN_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,199}")
MAX_POINTS = 200
"""Of a learning curve."""

NOT_A_SETTING = ("seed", "scale", "phase")
"""Keys that do not make another experiment within a phase and a scale."""
LOCAL_PATH = re.compile(r"""["']*(/|~|\$|\.\./|file:|[A-Za-z]:[\\/])""")
"""How a value begins that is a path of one machine."""

KEPT_OF_A_CLASS = ("AP", "AVE", "num_gt")
"""Within a range or a speed class; the run's metrics.json has the rest."""

Point = TypeVar("Point")
RECORD = {
    "run_id": (str,), "scale": (str,), "seed": (int,), "overrides": (list,), "data": (dict,), "commit": (str,),
    "versions": (dict,), "device": (str,), "processes": (int,), "threads": (int,), "initialized_from": (str, NONE),
    "epochs": (int,), "steps": (int,), "parameters": (int,), "resumed": (bool,), "seconds": (dict,),
    "peak_memory_mib": (dict,), "skipped_files": (dict,),
}  # fmt: skip
"""What a result takes from run.json as it is, and the types."""
INSIDE_RECORD = {
    ("data", "name"): (str,), ("data", "root"): (str,), ("seconds", "all"): NUMBER,
    ("peak_memory_mib", "process"): (int,),
}  # fmt: skip


@dataclass(kw_only=True)
class RunResult:
    """One finished run: what it was, and its numbers."""

    run_id: str
    model: str
    phase: str
    scale: str
    seed: int
    overrides: list[str]  # as typed, without those outside its identity
    data: dict[str, str]  # name, version, train_split, split, root (the folder's name: of a world its digest)
    commit: str
    versions: dict[str, str]
    device: str
    processes: int
    threads: int
    initialized_from: str | None  # run id, or digest of a checkpoint
    epochs: int  # of this phase
    steps: int
    parameters: int
    resumed: bool
    seconds: dict[str, float]  # fit, all
    peak_memory_mib: dict[str, int]  # process, largest_worker
    skipped_files: dict[str, int]
    config: dict[str, Any]  # tree of config.yaml, without keys outside its identity
    metrics: dict[str, float | None]
    """By the names of src/report/metric_names.py, as measured: fractions of 1, m/s, ms; None where there is no such
    ground truth; a name is absent where the run was not scored by it. Also speeds.<class>.<boxes | car.boxes>, how
    much ground truth there is."""
    curves: dict[str, list[list[float]]]  # [step, value] by column of metrics.csv: loss/*, val/*
    latency: dict[str, Any] | None  # content of latency.json

    @property
    def settings(self) -> tuple[str, ...]:
        """As `settings_of` its overrides."""
        return settings_of(self.overrides)

    @property
    def dataset(self) -> str:
        """Name of the data and digest of the world."""
        return f"{self.data['name']} {self.data['root']}"


def settings_of(overrides: Iterable[str]) -> tuple[str, ...]:
    """Overrides that define the experiment within its phase, sorted."""
    return tuple(sorted(override for override in overrides if key_of(override) not in NOT_A_SETTING))


def result_path(reports: Path, run_id: str) -> Path:
    """Where the result of a run lies."""
    return reports / "results" / f"{run_id}.json"


def finished_runs(outputs: Path, scale: str) -> Iterator[Path]:
    """Folders of one scale's finished runs, by name, without those that a restart moved aside."""
    for path in sorted(outputs.glob("*/run.json")):
        folder = path.parent
        if f"-{scale}-" in folder.name and ".before-" not in folder.name and (folder / "metrics.json").is_file():
            yield folder


def publish_result(run_folder: Path, reports: Path) -> Path:
    """Write the result of a finished run, unless it is there as it would be written; returns its path.

    Raises DataError naming file and key of a run folder that is not as a run leaves it, OSError naming the result for
    a disk that does not take it: the older one stays.
    """
    try:
        return _publish(run_folder, reports)
    except RecursionError as error:
        raise DataError(
            f"{run_folder}: a file of this run is nested too deeply; give the run's command again"
        ) from error


def _publish(run_folder: Path, reports: Path) -> Path:
    remedy = "delete run.json and metrics.json there and give the run's command again"
    record, scores = JsonObject(run_folder / "run.json", remedy), JsonObject(run_folder / "metrics.json", remedy)
    config = _read_config(run_folder / "config.yaml")
    latency_path = run_folder / "latency.json"
    latency = JsonObject(latency_path, "delete it and measure again") if latency_path.is_file() else None
    fields = _record(record)
    overrides = [_without_local_path(o) for o in fields["overrides"] if not is_of(o, OUTSIDE_IDENTITY)]
    _metrics(scores, latency)
    content = {
        "format": FORMAT,
        "model": config["model"]["name"],
        "phase": config["phase"]["name"],
        **fields,
        "overrides": overrides,
        "config": without_local_paths(config),
        "metrics": _slim(scores.content),
        "curves": _read_curves(run_folder / "metrics.csv"),
        "latency": latency.content if latency is not None else None,
    }
    lines = (f"{json.dumps(key)}: {json.dumps(value, allow_nan=False)}" for key, value in content.items())
    text = "{\n" + ",\n".join(lines) + "\n}\n"  # a line per key: compact, and a change is seen where it is
    if not RUN_ID.fullmatch(fields["run_id"]):
        raise record.refusal(("run_id",), f"must be the name of a folder, but is {fields['run_id']!r:.80}")
    path = result_path(reports, fields["run_id"])
    if not path.is_file() or path.read_bytes() != text.encode():
        write_whole(path, text)
    return path


def read_result(path: Path) -> RunResult:
    """Read one result. Raises DataError naming file, key, what was expected and found, and the remedy."""
    file = JsonObject(path, "delete it and run python -m src.report, which writes it anew from the run's folder")
    try:
        return _result(file)
    except RecursionError as error:  # just not too deep to be read, but too deep to be walked through
        raise file.too_deep() from error


def _result(file: JsonObject) -> RunResult:
    found = file.content.get("format")
    if found != FORMAT or type(found) is not int:
        raise file.refusal(("format",), f"must be {FORMAT}, the one that this version reads, but is {found!r:.80}")
    if file.get("run_id", str) != file.path.stem:
        raise file.refusal(
            ("run_id",), f"must be {file.path.stem}, as the file is named, but is {file.get('run_id', str)}"
        )
    scores = file.below("metrics")
    latency = file.below("latency") if file.get("latency", dict, NONE) is not None else None
    curves = file.get("curves", dict)
    for name, points in curves.items():
        if type(points) is not list or not all(map(_is_point, points)):
            raise file.refusal(("curves", name), f"must be a list of [step, value], but is {points!r:.80}")
    return RunResult(
        model=file.get("model", str),
        phase=file.get("phase", str),
        **_record(file),
        config=file.get("config", dict),
        metrics=_metrics(scores, latency),
        curves=curves,
        latency=latency.content if latency is not None else None,
    )


def read_results(reports: Path, scale: str | None = None) -> tuple[dict[str, RunResult], dict[Path, DataError]]:
    """Every result under reports/results, by run id, and what could not be read, by file."""
    results, broken = {}, {}
    for path in sorted((reports / "results").glob("*.json")):
        if scale is not None and f"-{scale}-" not in path.name:
            continue
        try:
            result = read_result(path)
        except DataError as error:
            broken[path] = error
        else:
            results[result.run_id] = result
    return results, broken


def _record(file: JsonObject) -> dict[str, Any]:
    fields = {name: file.get(name, *kinds) for name, kinds in RECORD.items()}
    for names, kinds in INSIDE_RECORD.items():
        file.get(names, *kinds)
    for index, override in enumerate(fields["overrides"]):
        if type(override) is not str:
            raise file.refusal(("overrides", str(index)), f"must be str, but is {override!r:.80}")
    return fields


def _metrics(scores: JsonObject, latency: JsonObject | None) -> dict[str, float | None]:
    """See RunResult.metrics."""
    values: dict[str, float | None] = {}
    for name in ("mAP", "NDS", "mAVE"):
        values[name] = scores.score(name)
    for name in scores.get("classes", dict):
        values[f"classes.{name}.AP"] = scores.score(("classes", name, "AP"))
    for name in scores.get("ranges", dict):
        values[f"ranges.{name}.mAP"] = scores.score(("ranges", name, "mAP"))
        for of in scores.get(("ranges", name, "classes"), dict):
            scores.get(("ranges", name, "classes", of), dict)
    for name in METRICS:
        path = name.split(".")
        if name not in values and path[0] not in ("speeds", "latency") and _has(scores.content, path):
            values[name] = scores.score(path, NONE)
    for name in scores.get("speeds", dict) if "speeds" in scores.content else ():  # older runs have no speed classes
        for key in ("mAP_present", "mAVE_present"):
            values[f"speeds.{name}.{key}"] = scores.score(("speeds", name, key), NONE)
        classes = ("speeds", name, "classes")
        boxes = [scores.get((*classes, of, "num_gt"), int) for of in scores.get(classes, dict)]
        cars = scores.get((*classes, "car", "num_gt"), int)
        values |= {f"speeds.{name}.boxes": sum(boxes), f"speeds.{name}.car.boxes": cars}
        for key in ("AP", "AVE"):  # the official numbers of a class without ground truth are 0 and 1, and say nothing
            value = scores.score((*classes, "car", key))
            values[f"speeds.{name}.car.{key}"] = value if cars else None
    if latency is not None:
        values |= {f"latency.{part}": latency.score(("ms", part)) for part in latency.get("ms", dict)}
        values |= {f"latency.{name}": latency.score(name) for name in ("fps", "memory_gb")}
        for part in latency.get("spread_ms", dict) if "spread_ms" in latency.content else ():
            latency.score(("spread_ms", part))
        for name in ("load", "cores"):  # older files have neither
            if name in latency.content:
                latency.score(name)
    return values


def _slim(scores: dict[str, Any]) -> dict[str, Any]:
    """metrics.json without the scores by tag, and by range and speed with less of each class: many are read fast."""

    def shortened(part: dict[str, Any]) -> dict[str, Any]:
        classes = {
            name: {key: values[key] for key in KEPT_OF_A_CLASS if key in values}
            for name, values in part.get("classes", {}).items()
        }
        return part | {"classes": classes}

    slim = {name: value for name, value in scores.items() if name != "tags"}
    for split in ("ranges", "speeds"):
        if split in slim:
            slim[split] = {name: shortened(part) for name, part in slim[split].items()}
    return slim


def _has(content: Any, path: Sequence[str]) -> bool:
    for name in path:
        if not isinstance(content, dict) or name not in content:
            return False
        content = content[name]
    return True


def _is_point(point: Any) -> bool:
    return type(point) is list and len(point) == 2 and type(point[0]) is int and type(point[1]) in NUMBER


def _read_config(path: Path) -> dict[str, Any]:
    try:
        content = load_plain_yaml(path.read_text())
        if not all(isinstance(content[part]["name"], str) for part in ("model", "phase")):
            raise TypeError("model.name and phase.name must be strings")
        json.dumps(content, allow_nan=False)  # a result holds it: no dates, and no number that is not finite
    except (OSError, ValueError, yaml.YAMLError, TypeError, KeyError) as error:
        what = " ".join(str(error).split())
        raise DataError(f"{path}: not a run's configuration ({type(error).__name__}: {what})") from error
    return content


def _read_curves(path: Path) -> dict[str, list[list[float]]]:
    """The losses and validation scores of metrics.csv, thinned out evenly to at most MAX_POINTS each."""
    curves: dict[str, list[list[float]]] = {}
    if not path.is_file():
        return curves
    try:
        with path.open(newline="") as file:
            for row in csv.DictReader(file):
                for name, value in row.items():
                    if name and name.startswith(("loss/", "val/")) and value and abs(float(value)) <= LARGEST:
                        curves.setdefault(name, []).append([int(row["step"]), float(value)])
    except (OSError, ValueError, TypeError, KeyError, csv.Error) as error:
        raise DataError(f"{path}: not a run's learning curves ({type(error).__name__}: {error}); delete it") from error
    return {name: thinned(points) for name, points in sorted(curves.items())}


def thinned(points: list[Point]) -> list[Point]:
    """At most MAX_POINTS of them, evenly; the first and the last stay."""
    last = len(points) - 1
    if last < MAX_POINTS:
        return points
    return [points[round(index * last / (MAX_POINTS - 1))] for index in range(MAX_POINTS)]


def _without_local_path(text: str) -> str:
    """`key=value`, or a value; a path of one machine becomes its last name and a digest."""
    key, equals, value = text.rpartition("=") if "=" in text else ("", "", text)
    if not LOCAL_PATH.match(value):
        return text
    name = re.split(r"[/\\]", value.strip("\"'").rstrip("/\\"))[-1]
    return f"{key}{equals}{name}@{hashlib.sha256(value.encode()).hexdigest()[:8]}"


def without_local_paths(config: dict[str, Any]) -> dict[str, Any]:
    """A run's configuration less what is outside its identity, its paths as `_without_local_path` writes them."""

    def clean(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: clean(inner) for key, inner in value.items()}
        if isinstance(value, list):
            return [clean(inner) for inner in value]
        return _without_local_path(value) if isinstance(value, str) else value

    return clean(without_keys(config, OUTSIDE_IDENTITY))
