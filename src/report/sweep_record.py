"""The state of a sweep: `reports/sweeps/<name>_<scale>.json`, enough to draw its tables without the configuration.

The runner writes it whenever something changes; tables and the dashboard read it. Imports neither torch nor Hydra.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, with_config

from src.errors import DataError, HorizonError
from src.files.atomic_write import write_whole
from src.report.json_format import CLOSED, Count, Many, parse_as, read_all, read_json
from src.report.sweep_file import SweepConfig
from src.training.identity import digest_of

FORMAT = 1
State = Literal["waiting", "running", "done", "failed", "pruned"]
Moment = Annotated[float, Field(ge=0, le=1e11)]
"""Seconds since 1970, for three thousand years; a calendar goes no further than three times that."""


@with_config(CLOSED)
@dataclass(kw_only=True)
class RunState:
    """The state of one planned run."""

    run_id: str
    overrides: Many[str]  # after `python -m src.train`; paths, devices and loggers of the machine are not among them
    seed: Count
    label: str  # of its first row; for a run that others only start from: what it is
    needs: str | None = None  # run whose weights it starts from
    state: State = "waiting"
    reason: str | None = None  # of a failure, in a line
    log: str | None = None  # relative to paths.outputs
    worker: str | None = None  # host and process that has it, while it runs
    started: Moment | None = None
    ended: Moment | None = None
    value: float | None = None  # of a search: the objective


@with_config(CLOSED)
@dataclass(kw_only=True)
class SweepRecord:
    """A sweep at one scale."""

    sweep: SweepConfig
    scale: str
    command: str  # that resumes it
    seeds: Many[Count]
    rows: dict[str, dict[Count, str]]  # run id by label and seed, in the order of the file; empty for a search
    runs: dict[str, RunState]  # by run id, in the order they are trained
    study: str  # Optuna's name of it
    storage: str  # the study's database, passwords masked
    changes: Many[str] = field(default_factory=list)  # by the command line, of every run: it is another experiment
    trials: Count = 0  # of a search: begun so far, each once; two that draw the same values share a run
    updated: Moment = 0.0  # when the runner last wrote this

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
    def labelled(self) -> list[tuple[str, str]]:
        """Label and run id of every row and seed, then of the runs of no row: of trials, and what rows start from."""
        rows = [(label, run_id) for label, by_seed in self.rows.items() for run_id in by_seed.values()]
        rowed = {run_id for _, run_id in rows}
        return rows + [(run.label, run_id) for run_id, run in self.runs.items() if run_id not in rowed]

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


@dataclass(kw_only=True)
class RecordFile(SweepRecord):
    """A record as its file holds it."""

    format: Annotated[int, Field(ge=FORMAT, le=FORMAT)]


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
    content = read_json(path, remedy)
    try:
        fields = vars(parse_as(RecordFile, content))
        del fields["format"]
        record = SweepRecord(**fields)
        _check(record, path.stem)
    except (ValueError, HorizonError) as error:
        raise DataError(f"{path}: not a readable record of a sweep ({error}); {remedy}") from error
    return record


def read_records(reports: Path, scale: str | None = None) -> tuple[list[SweepRecord], dict[Path, DataError]]:
    """Every record under reports/sweeps, by name, and what could not be read, by file."""
    records, broken = read_all(reports / "sweeps", read_record)
    return [record for record in records if scale is None or record.scale == scale], broken


def _check(record: SweepRecord, stem: str) -> None:
    """Raises ValueError for parts that do not fit each other."""
    if record.stem != stem:
        raise ValueError(f"it is the record of {record.stem}, whose file is {record.stem}.json")
    for run_id, run in record.runs.items():
        if run.run_id != run_id:
            raise ValueError(f"runs.{run_id}.run_id is {run.run_id!r}, must be {run_id!r}")
    for label, runs in record.rows.items():
        for seed, run_id in runs.items():
            if run_id not in record.runs:
                raise ValueError(f"rows.{label}.{seed} is {run_id!r}, which is not among runs")
