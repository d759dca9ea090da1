"""The state of a sweep: `reports/sweeps/<name>_<scale>.json`, enough to draw its tables without the configuration.

The runner writes it whenever something changes; tables and the dashboard read it. Imports neither torch nor Hydra.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import NoneType
from typing import Any, get_args, get_origin, get_type_hints

from src.errors import DataError, HorizonError
from src.report.atomic_write import write_whole
from src.report.sweep_file import SweepConfig
from src.training.identity import digest_of

FORMAT = 1
LAST_MOMENT = 1e11
"""Seconds since 1970, three thousand years on; a calendar goes no further than three times that."""
STATES = ("waiting", "running", "done", "failed", "pruned")


@dataclass(kw_only=True)
class RunState:
    """The state of one planned run."""

    run_id: str
    overrides: list[str]  # after `python -m src.train`; paths, devices and loggers of the machine are not among them
    seed: int
    label: str  # of its first row; for a run that others only start from: what it is
    needs: str | None = None  # run whose weights it starts from
    state: str = "waiting"  # one of STATES
    reason: str | None = None  # of a failure, in a line
    log: str | None = None  # relative to paths.outputs
    worker: str | None = None  # host and process that has it, while it runs
    started: float | None = None  # seconds since 1970
    ended: float | None = None
    value: float | None = None  # of a search: the objective


@dataclass(kw_only=True)
class SweepRecord:
    """A sweep at one scale."""

    sweep: SweepConfig
    scale: str
    command: str  # that resumes it
    seeds: list[int]
    rows: dict[str, dict[int, str]]  # run id by label and seed, in the order of the file; empty for a search
    runs: dict[str, RunState]  # by run id, in the order they are trained
    study: str  # Optuna's name of it
    storage: str  # the study's database, passwords masked
    changes: list[str] = field(default_factory=list)  # by the command line, of every run: it is another experiment
    trials: int = 0  # of a search: begun so far, each once; two that draw the same values share a run
    updated: float = 0.0  # when the runner last wrote this, seconds since 1970

    @property
    def name(self) -> str:
        """Name of the sweep's file."""
        return self.sweep.name

    @property
    def suffix(self) -> str:
        """What tells the names of this sweep's files from those of the sweep as its file says it."""
        return suffix_of(self.changes)

    @property
    def stem(self) -> str:
        """Name of the record's file, and the sweep's part of an address."""
        return f"{self.name}_{self.scale}{self.suffix}"

    @property
    def unchosen(self) -> int:
        """Trials of a search whose values have not been chosen yet."""
        return max(0, self.sweep.trials - self.trials) if self.sweep.is_search else 0

    @property
    def planned(self) -> int:
        """Runs, those of trials to come included."""
        return len(self.runs) + self.unchosen

    def count(self, state: str) -> int:
        """Runs in this state."""
        return sum(run.state == state for run in self.runs.values())


def suffix_of(changes: Sequence[str]) -> str:
    """`-` and 8 hex of what a command line changes of a sweep's file; empty for no change."""
    return f"-{digest_of(list(changes))}" if changes else ""


def record_path(reports: Path, sweep: str, scale: str, changes: Sequence[str] = ()) -> Path:
    """Where the record of a sweep lies."""
    return reports / "sweeps" / f"{sweep}_{scale}{suffix_of(changes)}.json"


def write_record(path: Path, record: SweepRecord) -> None:
    """Write the record so that it is never seen half-written, and an older one survives a full disk."""
    write_whole(path, json.dumps({"format": FORMAT, **dataclasses.asdict(record)}, indent=1) + "\n")


def read_record(path: Path) -> SweepRecord:
    """Raises DataError naming the file for anything that is not a record of this format."""
    remedy = "delete it and give the sweep's command again: finished runs are found and not trained anew"
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        json.dumps(content, ensure_ascii=False).encode()  # half of a surrogate pair is nothing a page can hold
        if not isinstance(content, dict):
            raise TypeError(f"must hold an object, but holds a {type(content).__name__}")
        found = content.pop("format", None)
        if found != FORMAT:
            raise ValueError(f"format is {found!r}, this version reads {FORMAT}")
        record = _built(SweepRecord, content, "")
        _check(record, path.stem)
    except (OSError, ValueError, TypeError, ArithmeticError, RecursionError, HorizonError) as error:
        raise DataError(
            f"{path}: not a readable record of a sweep ({type(error).__name__}: {error}); {remedy}"
        ) from error
    return record


def read_records(reports: Path, scale: str | None = None) -> tuple[list[SweepRecord], dict[Path, DataError]]:
    """Every record under reports/sweeps, by name, and what could not be read, by file."""
    records, broken = [], {}
    for path in sorted((reports / "sweeps").glob("*.json")):
        try:
            record = read_record(path)
        except DataError as error:
            broken[path] = error
            continue
        if scale is None or record.scale == scale:
            records.append(record)
    return records, broken


def _check(record: SweepRecord, stem: str) -> None:
    """Raises ValueError for parts that do not fit each other."""
    if record.stem != stem:
        raise ValueError(f"it is the record of {record.stem}, whose file is {record.stem}.json")
    moments = {f"runs.{run_id}.{name}": getattr(run, name)
               for run_id, run in record.runs.items() for name in ("started", "ended")}  # fmt: skip
    for name, moment in (moments | {"updated": record.updated}).items():
        if moment is not None and not 0 <= moment <= LAST_MOMENT:
            raise ValueError(f"{name} is {moment!r:.80}, must be seconds from 0 to {LAST_MOMENT:g}")
    for run_id, run in record.runs.items():
        if run.run_id != run_id:
            raise ValueError(f"runs.{run_id}.run_id is {run.run_id!r}, must be {run_id!r}")
        if run.state not in STATES:
            raise ValueError(f"runs.{run_id}.state is {run.state!r}, must be one of {', '.join(STATES)}")
    for label, runs in record.rows.items():
        for seed, run_id in runs.items():
            if run_id not in record.runs:
                raise ValueError(f"rows.{label}.{seed} is {run_id!r}, which is not among runs")


def _built(kind: Any, value: Any, where: str) -> Any:
    """A JSON value as its annotation says, dataclasses built. Raises TypeError and ValueError naming the place."""
    options = get_args(kind)
    if kind is Any:
        return value
    if NoneType in options:
        (other,) = set(options) - {NoneType}
        return None if value is None else _built(other, value, where)
    if dataclasses.is_dataclass(kind):
        found, types = _of(dict, value, where), _types_of(kind)
        unknown = sorted(found.keys() - types.keys())
        missing = [f.name for f in dataclasses.fields(kind) if f.name not in found and _is_required(f)]
        if unknown or missing:
            raise ValueError(f"{where or 'it'} lacks {missing}, and has {unknown}, which this version does not know")
        prefix = f"{where}." if where else ""
        return kind(**{name: _built(types[name], inner, f"{prefix}{name}") for name, inner in found.items()})
    if get_origin(kind) is list:
        return [_built(options[0], inner, f"{where}.{index}") for index, inner in enumerate(_of(list, value, where))]
    if get_origin(kind) is dict:
        read = int if options[0] is int else str  # the keys of a JSON object are words
        items = _of(dict, value, where).items()
        return {read(key): _built(options[1], inner, f"{where}.{key}") for key, inner in items}
    if kind is float and type(value) in (int, float) and math.isfinite(value):
        return value
    return _of(kind, value, where)


def _of(kind: type, value: Any, where: str) -> Any:
    if type(value) is not kind or (kind is float and not math.isfinite(value)):
        names = {dict: "an object", float: "a finite number", int: "a whole number", str: "a text"}
        raise TypeError(f"{where} must be {names.get(kind, kind.__name__)}, but is {value!r:.80}")
    return value


@functools.cache
def _types_of(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)


def _is_required(entry: dataclasses.Field) -> bool:
    return entry.default is dataclasses.MISSING and entry.default_factory is dataclasses.MISSING
