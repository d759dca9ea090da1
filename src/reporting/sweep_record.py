"""What became of a sweep: `reports/sweeps/<name>_<scale>.json`, enough to draw its tables without the configuration.

The runner writes it whenever something changes; tables and the dashboard read it. Imports neither torch nor Hydra.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from src.errors import DataError
from src.reporting.sweep_file import DimensionConfig, PaperRowConfig, PlotConfig, RowConfig, SweepConfig, TableConfig
from src.reporting.writing import write_whole

FORMAT = 1
STATES = ("waiting", "running", "done", "failed", "pruned")


@dataclass(kw_only=True)
class RunState:
    """Where one planned run stands."""

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
    command: str  # that goes on with it
    seeds: list[int]
    rows: dict[str, dict[int, str]]  # run id by label and seed, in the order of the file; empty for a search
    runs: dict[str, RunState]  # by run id, in the order they are trained
    study: str  # Optuna's name of it
    storage: str  # the study's database, passwords masked
    trials: int = 0  # of a search: begun so far, each once; two that draw the same values share a run
    updated: float = 0.0  # when the runner last wrote this, seconds since 1970

    @property
    def name(self) -> str:
        """Name of the sweep's file."""
        return self.sweep.name

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


def record_path(reports: Path, sweep: str, scale: str) -> Path:
    """Where the record of a sweep lies."""
    return reports / "sweeps" / f"{sweep}_{scale}.json"


def write_record(path: Path, record: SweepRecord) -> None:
    """Write the record so that it is never seen half-written, and an older one survives a full disk."""
    write_whole(path, json.dumps({"format": FORMAT, **dataclasses.asdict(record)}, indent=1) + "\n")


def read_record(path: Path) -> SweepRecord:
    """Raises DataError naming the file for anything that is not a record of this format."""
    remedy = "delete it and give the sweep's command again: finished runs are found and not trained anew"
    try:
        content = json.loads(path.read_text())
        if not isinstance(content, dict):
            raise TypeError(f"must hold an object, but holds a {type(content).__name__}")
        found = content.pop("format", None)
        if found != FORMAT:
            raise ValueError(f"format is {found!r}, this version reads {FORMAT}")
        return _record(content)
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise DataError(
            f"{path}: not a readable record of a sweep ({type(error).__name__}: {error}); {remedy}"
        ) from error


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


def _record(content: dict[str, Any]) -> SweepRecord:
    sweep = dict(content["sweep"])
    sweep["tables"] = [TableConfig(**table) for table in sweep["tables"]]
    sweep["plots"] = [PlotConfig(**plot) for plot in sweep["plots"]]
    sweep["paper_rows"] = [PaperRowConfig(**row) for row in sweep["paper_rows"]]
    sweep["rows"] = [RowConfig(**row) for row in sweep["rows"]]
    sweep["space"] = {key: DimensionConfig(**dimension) for key, dimension in sweep["space"].items()}
    rows = {label: {int(seed): run for seed, run in runs.items()} for label, runs in content["rows"].items()}
    runs = {run_id: RunState(**run) for run_id, run in content["runs"].items()}
    for run_id, run in runs.items():
        if run.state not in STATES:
            raise ValueError(f"runs.{run_id}.state is {run.state!r}, must be one of {', '.join(STATES)}")
    return SweepRecord(**(content | {"sweep": SweepConfig(**sweep), "rows": rows, "runs": runs}))
