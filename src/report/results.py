"""Finished runs as `reports/results/<run_id>.json`: written from a run's folder, checked when read. Never torch."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import Field, with_config
from pydantic_core import from_json

from src.errors import DataError
from src.files.atomic_write import write_whole
from src.report.json_format import OPEN, Count, Many, Measure, read_all, read_as, read_json
from src.report.metric_names import DETECTION, METRICS
from src.report.plain_yaml import load_plain_yaml
from src.report.result_schema import (
    Bounds,
    CpuProducts,
    DataNames,
    Latency,
    OtherScores,
    PeakMemory,
    Scores,
    Seconds,
)
from src.report.run_curves import curves_of
from src.training.identity import OUTSIDE_IDENTITY, canonical, is_of, key_of, without_keys

FORMAT = 1
FOLDER_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,199}")

NOT_A_SETTING = ("seed", "scale", "phase")
"""Keys that do not make another experiment within a phase and a scale."""
LOCAL_PATH = re.compile(r"""["']*(/|~|\$|\.\./|file:|[A-Za-z]:[\\/])""")
"""How a value begins that is a path of one machine."""

KEPT_OF_A_CLASS = ("AP", "AP_normalized", "AVE", "num_gt")
"""What a result keeps of a class within a range or a speed class; the run's metrics.json has the rest."""


@with_config(OPEN)
@dataclass(kw_only=True)
class RunRecord:
    """What run.json says of a finished run."""

    run_id: str
    task: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,99}$")] = DETECTION
    headline: str = "mAP"  # the task's main number; older records have neither
    scale: str
    seed: Count
    overrides: Many[str]  # as typed, in a result without those outside its identity
    data: DataNames
    commit: str
    versions: dict[str, str]
    device: str
    processes: Count
    threads: Count
    cpu_products: CpuProducts | None = None  # what a CPU multiplies by and in; older results do not have it
    initialized_from: str | None  # run id, or digest of a checkpoint
    epochs: Count  # of this phase
    steps: Count
    parameters: Count
    resumed: bool
    seconds: Seconds
    peak_memory_mib: PeakMemory
    skipped_files: dict[str, Count]
    weights: str | None = None  # digest of the run's checkpoint, and ...
    initial_weights: str | None = None  # ... of the one it began from; older records have neither


@dataclass(kw_only=True)
class RunResult(RunRecord):
    """One finished run: what it was, and its numbers."""

    model: str
    phase: str
    config: dict[str, Any]  # tree of config.yaml, without keys outside its identity
    metrics: dict[str, float | None]
    """Numbers by their names in src/report/metric_names.py, as measured: fractions of 1, m/s, ms; None where there is
    no such ground truth; a name is absent where the run was not scored by it. Also speeds.<class>.<boxes | car.boxes>,
    how much ground truth there is. Of another task than detection: the numbers that its metrics.json has at the top."""
    curves: dict[str, Many[Annotated[list[Measure], Field(min_length=2, max_length=2)]]]
    """[step, value] by column of metrics.csv: loss/*, val/*."""
    latency: Latency | None
    intervals: dict[str, Bounds] = field(default_factory=dict)
    """95 % interval of a metric over the scenes it was scored on; older runs and runs on one scene have none."""
    scenes: Count = 0  # behind the intervals

    @property
    def settings(self) -> tuple[str, ...]:
        """What makes the run another experiment within its phase, see `settings_of`."""
        return settings_of(self.overrides)

    @property
    def training_s(self) -> float | None:
        """How long it trained and validated; None of an older run that was resumed: only its last session is known."""
        return None if self.resumed and "earlier" not in self.seconds else self.seconds["all"]

    @property
    def dataset(self) -> str:
        """Name of the data and digest of the world."""
        return f"{self.data['name']} {self.data['root']}"


@dataclass(kw_only=True)
class ResultFile(RunResult):
    """A result as `reports/results/<run_id>.json` holds it: the metrics as in metrics.json."""

    format: Annotated[int, Field(ge=FORMAT, le=FORMAT)]
    metrics: Scores


@dataclass(kw_only=True)
class OtherResultFile(ResultFile):
    """The result of another task than detection, as its file holds it."""

    metrics: OtherScores


def settings_of(overrides: Iterable[str]) -> tuple[str, ...]:
    """Overrides that define the experiment within its phase, in one spelling, sorted."""
    return tuple(sorted(canonical(override) for override in overrides if key_of(override) not in NOT_A_SETTING))


def result_path(reports: Path, run_id: str) -> Path:
    """Where the result of a run lies."""
    return reports / "results" / f"{run_id}.json"


def is_finished(folder: Path) -> bool:
    """Whether both files that mark a finished run are there."""
    return (folder / "run.json").is_file() and (folder / "metrics.json").is_file()


def finished_runs(outputs: Path, scale: str) -> Iterator[Path]:
    """Folders of one scale's finished runs, by name, without those that a restart moved aside."""
    for path in sorted(outputs.glob("*/run.json")):
        folder = path.parent
        if f"-{scale}-" in folder.name and ".before-" not in folder.name and is_finished(folder):
            yield folder


def publish_result(run_folder: Path, reports: Path) -> Path:
    """Write the result of a finished run, unless it is there as it would be written; returns its path.

    Raises DataError naming file and key of a run folder that is not as a run leaves it, OSError naming the result for
    a disk that does not take it: the older one stays.
    """
    remedy = "delete run.json and metrics.json there and give the run's command again"
    record = read_as(RunRecord, run_folder / "run.json", remedy)
    found, name = f"{run_folder / 'run.json'}: run_id", record.run_id
    if not FOLDER_NAME.fullmatch(name):
        raise DataError(f"{found} must be the name of a folder, but is {name!r:.80}; {remedy}")
    if name != (own := run_folder.name):
        raise DataError(f"{found} must be {own}, the folder's name, but is {name}; move a copy elsewhere")
    is_detection = record.task == DETECTION
    metrics_path = run_folder / "metrics.json"
    scores = read_as(Scores if is_detection else OtherScores, metrics_path, remedy)
    if is_detection:
        scores = _slim(from_json(metrics_path.read_bytes()))
    else:
        intervals = {"intervals": scores["intervals"]} if "intervals" in scores else {}
        scores = _numbers(scores, record.headline, metrics_path, remedy) | intervals
    config = _read_config(run_folder / "config.yaml")
    latency_path = run_folder / "latency.json"
    if latency_path.is_file():
        latency = read_as(Latency, latency_path, "delete it and measure again")
    else:
        latency = _of_fresh_weights(result_path(reports, record.run_id))
    overrides = [_without_local_path(o) for o in record.overrides if not is_of(o, OUTSIDE_IDENTITY)]
    content = {
        "format": FORMAT,
        "model": config["model"]["name"],
        "phase": config["phase"]["name"],
        **vars(record),
        "overrides": overrides,
        "config": without_local_paths(config),
        "metrics": scores,
        "curves": curves_of(run_folder / "metrics.csv"),
        "latency": latency,
    }
    return _write_result(result_path(reports, record.run_id), content)


def _of_fresh_weights(path: Path) -> Latency | None:
    """The latency that a result has without its run's weights, if any, so that publishing the run leaves it."""
    try:
        latency = read_result(path).latency
    except DataError:  # there is none yet, or one that is about to be written anew
        return None
    return None if latency is None or latency.get("trained", True) else latency


def publish_latency(folder: Path, reports: Path, run_id: str) -> Path:
    """Give a result the latency that was measured into `latency.json` of a folder; returns the result's path.

    Raises DataError naming file and key where either is not as it should be.
    """
    path = result_path(reports, run_id)
    read_result(path)
    latency = read_as(Latency, folder / "latency.json", "delete it and measure again")
    return _write_result(path, from_json(path.read_bytes()) | {"latency": latency})


def _write_result(path: Path, content: dict[str, Any]) -> Path:
    """Write a result, unless the file already holds just that; returns its path."""
    lines = (f"{json.dumps(key)}: {json.dumps(value)}" for key, value in content.items())
    text = "{\n" + ",\n".join(lines) + "\n}\n"  # a line per key: compact, and a change is seen where it is
    if not path.is_file() or path.read_bytes() != text.encode():
        write_whole(path, text)
    return path


def read_result(path: Path) -> RunResult:
    """Read one result. Raises DataError naming file, key, what was expected and found, and the remedy."""
    remedy = (
        "restore it (git checkout), or delete it and run python -m src.report, which writes it anew where the run's "
        "folder is"
    )
    content = from_json(read_json(path, remedy))
    is_detection = not isinstance(content, dict) or content.get("task", DETECTION) == DETECTION
    fields = vars(read_as(ResultFile if is_detection else OtherResultFile, path, remedy))
    del fields["format"]
    if fields["run_id"] != path.stem:
        raise DataError(f"{path}: run_id must be {path.stem}, the file's name, but is {fields['run_id']}; {remedy}")
    if is_detection:
        numbers = _flat_scores(fields["metrics"])
    else:
        numbers = _numbers(fields["metrics"], fields["headline"], path, remedy)
    if (found := fields["metrics"].get("intervals")) is not None:
        bounds = _named(found["bounds"]) if is_detection else found["bounds"]
        fields |= {"intervals": bounds, "scenes": found["scenes"]}
    if (latency := fields["latency"]) is not None:
        numbers |= {f"latency.{part}": value for part, value in latency["ms"].items()}
        numbers |= {f"latency.{name}": latency[name] for name in ("fps", "memory_gb", "gflop") if name in latency}
    result = RunResult(**fields | {"metrics": numbers})
    numbers |= {"cost.parameters": result.parameters, "cost.training": result.training_s}
    return result


def read_results(reports: Path, scale: str | None = None) -> tuple[dict[str, RunResult], dict[Path, DataError]]:
    """Every result under reports/results, by run id, and what could not be read, by file."""
    results, broken = read_all(reports / "results", read_result, "*.json" if scale is None else f"*-{scale}-*.json")
    return {result.run_id: result for result in results}, broken


def read_results_or_raise(reports: Path, scale: str, wanted: Collection[str] | None = None) -> dict[str, RunResult]:
    """Results as `read_results`; raises DataError naming those of `wanted` runs (None: all) that cannot be read."""
    results, broken = read_results(reports, scale)
    faults = [str(error) for path, error in broken.items() if wanted is None or path.stem in wanted]
    if faults:
        raise DataError("\n".join(faults))
    return results


def _numbers(scores: OtherScores, headline: str, path: Path, remedy: str) -> dict[str, float | None]:
    """The numbers at the top of metrics.json, not nested ones. Raises DataError for a missing headline number."""
    if not isinstance(scores.get(headline), float):
        raise DataError(f"{path}: {headline}, the headline number of its task, is missing; {remedy}")
    return {name: value for name, value in scores.items() if not isinstance(value, dict)}


def _flat_scores(scores: Scores) -> dict[str, float | None]:
    """Scores of detection, flattened to the names of `RunResult.metrics`."""
    groups = {"": scores, "measures.": scores.get("measures", {})}
    groups |= {f"classes.{name}.": part for name, part in scores["classes"].items()}
    groups |= {f"ranges.{name}.": part for name, part in scores["ranges"].items()}
    if (long_range := scores.get("long_range")) is not None:
        groups["long_range."] = long_range
        groups |= {f"long_range.ranges.{name}.": part for name, part in long_range["ranges"].items()}
    values = {prefix + key: value for prefix, part in groups.items() for key, value in part.items()}
    values = {name: value for name, value in values.items() if name in METRICS}
    for name, part in scores.get("speeds", {}).items():
        classes, prefix = part["classes"], f"speeds.{name}."
        means = ("mAP_present", "mAVE_present", "mAP_normalized")
        values |= {prefix + key: part[key] for key in means if key in part}
        values[prefix + "boxes"] = sum(of_class["num_gt"] for of_class in classes.values())
        values[prefix + "car.boxes"] = classes["car"]["num_gt"]
        # The official numbers of a class without ground truth are 0 and 1, and say nothing; nor does the error of one
        # of which hardly anything is found, officially 1.
        for word, of_class in classes.items():
            for key in ("AP", "AP_normalized"):
                if key in of_class:
                    values[f"{prefix}{word}.{key}"] = of_class[key] if of_class["num_gt"] else None
        car = classes["car"]
        values[prefix + "car.AVE"] = car["AVE"] if car["num_gt"] and car["AVE"] != 1.0 else None
    return values


def _named(bounds: dict[str, Bounds]) -> dict[str, Bounds]:
    """Intervals by the names of src/report/metric_names.py; those without a name there are left out."""
    named = {
        path.replace(".classes.", ".") if path.startswith("speeds.") else path: values
        for path, values in bounds.items()
    }
    return {name: values for name, values in named.items() if name in METRICS}


def _slim(scores: dict[str, Any]) -> dict[str, Any]:
    """metrics.json without the scores by tag, and by range and speed with less of each class: many are read fast.

    Of intervals only those that have a name in tables.
    """

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
    if (further := slim.get("long_range")) is not None:
        ranges = {name: shortened(part) for name, part in further["ranges"].items()}
        slim["long_range"] = shortened(further) | {"ranges": ranges}
    if "intervals" in slim:
        bounds = {path: values for path, values in slim["intervals"]["bounds"].items() if _named({path: values})}
        slim["intervals"] = slim["intervals"] | {"bounds": bounds}
    return slim


def _read_config(path: Path) -> dict[str, Any]:
    try:
        content = load_plain_yaml(path.read_text())
        if not all(isinstance(content[part]["name"], str) for part in ("model", "phase")):
            raise TypeError("model.name and phase.name must be strings")
        json.dumps(content, allow_nan=False)  # a result holds it: no dates, and no number that is not finite
    except (OSError, ValueError, yaml.YAMLError, TypeError, KeyError) as error:
        what = " ".join(str(error).split())
        raise DataError(
            f"{path}: not a run's configuration ({type(error).__name__}: {what}); give the run's command again with "
            "resume=restart, or remove its folder"
        ) from error
    return content


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
