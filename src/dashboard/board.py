"""Everything the dashboard shows, read from paths.reports and, where it is there, paths.outputs."""

from __future__ import annotations

import functools
import logging
import operator
import threading
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from src.dashboard.folders import ALIVE_S, RunFolders
from src.errors import DataError
from src.report.results import RunResult, read_result, settings_of
from src.report.sweep_record import RunState, SweepRecord, read_record
from src.report.sweep_table import SweepTable
from src.report.table_builder import sweep_tables
from src.report.time_left import seconds_left
from src.training.identity import RUN_ID

logger = logging.getLogger(__name__)
STALLED_S = 120.0
"""A runner whose runs write neither log nor metrics for this long has probably been killed."""
SCALES = ("paper", "mini", "debug")
STATES = ("running", "done", "failed", "pruned", "stopped", "waiting")
"""States of a run. Where sweeps that share a run differ, the first of these that one of them states holds."""
Stamp = tuple[int, int]  # of a file: time of change and size


@dataclass(kw_only=True)
class Sweep:
    """One sweep at one scale, as of `now`."""

    record: SweepRecord
    tables: list[SweepTable]
    problem: str | None  # why there are no tables
    written: float  # when the runner or one of its running runs last wrote something, seconds since 1970
    now: float

    @property
    def key(self) -> str:
        """The sweep's part of an address: the record's file name."""
        return self.record.stem

    @property
    def state(self) -> str:
        """`done`, `running`, `stalled` (a run is running, and nothing is written), `unfinished`, or `failed`."""
        if self.record.count("running"):
            return "stalled" if self.idle_s > STALLED_S else "running"
        if self.record.count("waiting") or self.record.unchosen:
            return "unfinished" if self.idle_s > STALLED_S else "running"
        return "failed" if self.record.count("failed") else "done"

    @property
    def state_words(self) -> str:
        """The state as people say it."""
        return {"failed": "ended with failures", "unfinished": "not finished"}.get(self.state, self.state)

    @property
    def idle_s(self) -> float:
        """How long ago the runner, or what it runs, last wrote."""
        return max(0.0, self.now - self.written)

    @property
    def left_s(self) -> float | None:
        """Time left, with as many runs side by side as now; None before the first has finished, and when none runs."""
        if self.state != "running":
            return None
        return seconds_left(self.record.runs.values(), 1, self.now, self.record.unchosen)


@dataclass(kw_only=True)
class Run:
    """One run: finished (with a result), of a sweep, or a folder that is being trained in."""

    run_id: str
    state: str  # of a sweep record, or `stopped`: unfinished and idle, its runner killed or not part of a sweep
    result: RunResult | None = None
    planned: RunState | None = None
    has_folder: bool = False
    rows: list[tuple[str, str]] = field(default_factory=list)  # key of a sweep and label of the row, first is shown

    @property
    def parts(self) -> list[str]:
        """Model, phase, scale and digest, from its name; of a folder named otherwise its name and nothing."""
        named = RUN_ID.fullmatch(self.run_id)
        return list(named.groups()) if named else [self.run_id, "", "", ""]

    @property
    def phase(self) -> str:
        """Name of the phase, such as `phase1`."""
        return self.parts[1]

    @property
    def scale(self) -> str:
        """Name of the scale, such as `mini`."""
        return self.result.scale if self.result else self.parts[2]

    @property
    def seed(self) -> int | None:
        """Seed of the run; None where only its folder is known."""
        return self.result.seed if self.result else self.planned.seed if self.planned else None

    @property
    def settings(self) -> tuple[str, ...]:
        """Overrides that make it another experiment within its phase."""
        return settings_of(self.result.overrides if self.result else self.planned.overrides if self.planned else ())

    @property
    def title(self) -> str:
        """Row of its first sweep, or what was changed."""
        return self.rows[0][1] if self.rows else " ".join(self.settings) or "defaults"


@dataclass(kw_only=True)
class Board:
    """One reading of everything."""

    sweeps: list[Sweep]
    runs: dict[str, Run]
    broken: dict[str, str]  # file, relative to paths.reports, and what is wrong with it
    folders: RunFolders
    has_reports: bool
    now: float

    @property
    def live(self) -> bool:
        """Whether something is being trained."""
        return any(sweep.state == "running" for sweep in self.sweeps) or any(
            run.state == "running" for run in self.runs.values()
        )

    @property
    def scales(self) -> list[str]:
        """Scales that have a sweep or a run, the largest first."""
        found = {sweep.record.scale for sweep in self.sweeps} | {run.scale for run in self.runs.values()}
        return sorted(found, key=lambda scale: (SCALES.index(scale) if scale in SCALES else len(SCALES), scale))

    def sweep(self, key: str) -> Sweep | None:
        """The sweep with this `key`; None where there is none."""
        return next((sweep for sweep in self.sweeps if sweep.key == key), None)

    def baseline_of(self, run: Run) -> tuple[Run, str] | None:
        """What a run is compared with, and its name: its sweep's baseline row of the same seed, else plain defaults."""
        for key, label in run.rows:
            record = self.sweep(key).record
            baseline = record.sweep.baseline_of(label) if label in record.rows else None
            other = record.rows.get(baseline or "", {}).get(run.seed)
            if other is not None and other != run.run_id and other in self.runs:
                return self.runs[other], f"{baseline} (baseline)"
        if not run.settings:
            return None
        plain = self._plain_runs.get(_kind(run)) if run.result is not None else None
        return (plain, "defaults") if plain is not None else None

    @functools.cached_property
    def _plain_runs(self) -> dict[tuple[Any, ...], Run]:
        """Finished runs without any setting."""
        plain = (run for run in self.runs.values() if run.result is not None and not run.settings)
        return {_kind(run): run for run in plain}


class BoardReader:
    """Reads the board, and only files that changed since the last time; safe to call from several threads."""

    def __init__(self, reports: Path, outputs: Path | None) -> None:
        self.reports = reports
        self.outputs = outputs
        self._files: dict[Path, tuple[Stamp, object]] = {}
        self._tables: dict[Path, tuple[list[object], list[SweepTable], str | None]] = {}
        self._lock = threading.Lock()
        self._board: Board | None = None
        self._mark: object = None

    def read(self) -> tuple[Board, str]:
        """The board, and a mark that changes when it does."""
        with self._lock:
            now = time.time()
            folders = RunFolders(self.outputs)
            names = folders.names()
            stamps = {path: stamp for kind in ("sweeps", "results") for path, stamp in _stamps(self.reports / kind)}
            unfinished = {name: folders.written(name) for name in names if not folders.has_result(name)}
            mark = (tuple(stamps.items()), tuple(unfinished.items()), tuple(names))
            # Times on the page (left, idle) advance in steps while something runs.
            step = 15.0 if self._board is not None and self._board.live else 600.0
            if self._board is None or mark != self._mark or now - self._board.now > step:
                self._board, self._mark = self._assemble(stamps, names, unfinished, folders, now), mark
            return self._board, f"{hash((mark, self._board.now)) & 0xFFFFFFFFFFFFFFFF:016x}"

    def _assemble(
        self, stamps: dict[Path, Stamp], names: list[str], unfinished: dict[str, float | None],
        folders: RunFolders, now: float,
    ) -> Board:  # fmt: skip
        records, results, broken = self._read_files(stamps)
        sweeps, not_shown = self._sweeps(records, results, folders, now)
        runs = _runs_of(results, sweeps)
        _add_folders(runs, names, unfinished, now)
        return Board(
            sweeps=sweeps, runs=runs, broken=broken | not_shown, folders=folders, has_reports=self.reports.is_dir(),
            now=now,
        )  # fmt: skip

    def _read_files(
        self, stamps: dict[Path, Stamp]
    ) -> tuple[dict[Path, SweepRecord], dict[str, RunResult], dict[str, str]]:
        """Records by file, results by run, and by file what is wrong with the others."""
        records, results, broken = {}, {}, {}
        for path, stamp in stamps.items():
            content = self._cached(path, stamp)
            if isinstance(content, DataError):
                # A file that is committed or sent around says nothing of where it was made.
                broken[str(path.relative_to(self.reports))] = (
                    str(content).replace(f"{path}: ", "").replace(f"{self.reports}/", "")
                )
            elif isinstance(content, SweepRecord):
                records[path] = content
            else:
                results[content.run_id] = content
        self._files = {path: content for path, content in self._files.items() if path in stamps}
        return records, results, broken

    def _sweeps(
        self, records: dict[Path, SweepRecord], results: dict[str, RunResult], folders: RunFolders, now: float
    ) -> tuple[list[Sweep], dict[str, str]]:  # fmt: skip
        """The sweeps, and by file why some cannot be shown."""
        sweeps, not_shown = [], {}
        self._tables = {path: known for path, known in self._tables.items() if path in records}
        for path, record in records.items():
            try:
                sweep = self._sweep(path, record, results, folders, now)
                _ = sweep.state, sweep.left_s, [settings_of(run.overrides) for run in record.runs.values()]
            except Exception as error:  # one bad record must not hide the others
                logger.exception("%s cannot be shown", path)
                not_shown[str(path.relative_to(self.reports))] = f"{type(error).__name__}: {error}"
            else:
                sweeps.append(sweep)
        return sweeps, not_shown

    def _sweep(
        self, path: Path, record: SweepRecord, results: dict[str, RunResult], folders: RunFolders, now: float
    ) -> Sweep:  # fmt: skip
        running = [run for run in record.runs.values() if run.state == "running"]
        signs = [folders.written(run.run_id, run.log) for run in running]
        written = max([record.updated, *(sign for sign in signs if sign is not None)])
        tables, problem = self._tables_of(path, record, results)
        return Sweep(record=record, tables=tables, problem=problem, written=written, now=now)

    def _tables_of(
        self, path: Path, record: SweepRecord, results: dict[str, RunResult]
    ) -> tuple[list[SweepTable], str | None]:
        """Tables, or what is wrong with them; made anew where the record or a result of it has been read anew."""
        shown = {*record.runs, *(run for runs in record.rows.values() for run in runs.values())}
        sources = [record, *(results.get(run) for run in sorted(shown))]
        known = self._tables.get(path)
        if known is None or len(known[0]) != len(sources) or any(map(operator.is_not, known[0], sources)):
            try:
                known = (sources, sweep_tables(record, results), None)
            except (ValueError, DataError) as error:
                known = (sources, [], str(error))
            self._tables[path] = known
        return known[1], known[2]

    def _cached(self, path: Path, stamp: Stamp) -> RunResult | SweepRecord | DataError:
        known = self._files.get(path)
        if known is not None and known[0] == stamp:
            return known[1]
        try:
            if not path.resolve().is_relative_to(self.reports.resolve()):
                raise DataError(
                    f"{path}: a link that leads out of the reports folder, which is not followed; delete it"
                )
            if not path.is_file():
                raise DataError(f"{path}: not a file; delete it")
            content = read_record(path) if path.parent.name == "sweeps" else read_result(path)
        except DataError as error:
            content = error
        except Exception as error:  # one bad file must not hide the others
            logger.exception("%s cannot be read", path)
            content = DataError(f"{path}: not readable ({type(error).__name__}: {error}); delete it")
        self._files[path] = (stamp, content)
        return content


def _runs_of(results: dict[str, RunResult], sweeps: list[Sweep]) -> dict[str, Run]:
    """Runs that have a result or that a sweep plans."""
    runs = {run_id: Run(run_id=run_id, state="done", result=result) for run_id, result in results.items()}
    for sweep in sweeps:
        for run_id, planned in sweep.record.runs.items():
            killed = planned.state == "running" and sweep.state != "running"
            state = "stopped" if killed else planned.state
            run = runs.setdefault(run_id, Run(run_id=run_id, state=state))
            run.planned = run.planned or planned
            if run.result is None and STATES.index(state) < STATES.index(run.state):  # in another sweep
                run.state, run.planned = state, planned
        for label, run_id in sweep.record.labelled:
            runs[run_id].rows.append((sweep.key, label))
    return runs


def _add_folders(runs: dict[str, Run], names: list[str], unfinished: dict[str, float | None], now: float) -> None:
    """Note which runs have a folder, and add those that nothing else tells of."""
    for name in names:
        alive = now - (unfinished.get(name) or 0.0) < ALIVE_S
        state = "running" if name in unfinished and alive else "stopped" if name in unfinished else "done"
        run = runs.setdefault(name, Run(run_id=name, state=state))
        run.has_folder = True
        if run.state == "waiting" and name in unfinished:  # no runner has begun it, so somebody else has
            run.state = state


def _kind(run: Run) -> tuple[Any, ...]:
    """What two finished runs must share for their numbers to compare."""
    return (*run.parts[:3], run.result.task, run.result.dataset, run.seed)


def _stamps(folder: Path) -> Iterable[tuple[Path, Stamp]]:
    """JSON files of a folder, by name."""
    if not folder.is_dir():
        return
    for path in sorted(folder.glob("*.json")):
        try:
            status = path.stat()
        except OSError:
            continue
        yield path, (status.st_mtime_ns, status.st_size)
