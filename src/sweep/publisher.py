"""The record of a sweep from the plan, the trials and the files; written under the study's lock."""

from __future__ import annotations

import logging
import math
import time
from pathlib import Path

from src.errors import DataError
from src.reliability.passwords import masked
from src.report.sweep_record import RunState, SweepRecord, read_record, record_path, write_record
from src.sweep.plan import Cell, Plan
from src.sweep.run_status import is_done
from src.sweep.sweep_study import Attempt, SweepStudy, trials_begun
from src.training.identity import is_of

logger = logging.getLogger(__name__)


class Keeper:
    """Writes the record of a plan, `reports/sweeps/<stem>.json`, whenever asked; several runners may."""

    def __init__(self, plan: Plan, study: SweepStudy, command: str, outputs: Path, reports: Path) -> None:
        self.plan, self.study, self.command, self.outputs, self.reports = plan, study, command, outputs, reports
        self.path = record_path(reports, plan.sweep.name, plan.scale, plan.changes)
        self._done: set[str] = set()

    def is_done(self, run_id: str) -> bool:
        """Whether the run is finished and has a score; what was once is not looked at again."""
        if run_id not in self._done and is_done(self.outputs / run_id):
            self._done.add(run_id)
        return run_id in self._done

    def write(self) -> SweepRecord:
        """Build and write the record of this moment. A full disk is only told of: finished runs do not depend on it."""
        with self.study.lock():
            record = self._build(self.study.attempts())
            try:
                write_record(self.path, record)
            except OSError as error:
                logger.warning("%s could not be written (%s); the sweep goes on", self.path, error)
        return record

    def _build(self, attempts: list[Attempt]) -> SweepRecord:
        latest = {attempt.run_id: attempt for attempt in attempts if attempt.run_id is not None}
        runs = {cell.run_id: self._state(cell, latest.get(cell.run_id)) for cell in self.plan.cells.values()}
        if self.plan.sweep.is_search:
            for attempt in attempts:
                for cell in map(cell_from, attempt.attrs.get("cells", [])):
                    trial = latest.get(cell.run_id)
                    # What a trial starts from has no trial of its own and is trained by that one.
                    own = trial or (attempt if attempt.state == "running" else None)
                    runs[cell.run_id] = self._state(cell, own)
        record = SweepRecord(
            sweep=self.plan.sweep,
            scale=self.plan.scale,
            command=self.command,
            seeds=list(self.plan.seeds),
            rows={label: dict(by_seed) for label, by_seed in self.plan.rows.items()},
            runs=runs,
            study=self.study.name,
            storage=masked(self.study.url),
            changes=list(self.plan.changes),
            trials=trials_begun(attempts),
            updated=time.time(),
        )
        self._keep_earlier_seeds(record, latest)
        return record

    def _state(self, cell: Cell, attempt: Attempt | None) -> RunState:
        log = self.study.folder / f"{cell.run_id}.log"
        state = RunState(
            run_id=cell.run_id,
            overrides=cell.overrides,
            seed=cell.seed,
            label=cell.label,
            needs=cell.needs,
            log=str(log.relative_to(self.outputs)) if log.is_file() else None,
        )
        if attempt is not None:
            state.started, state.ended = attempt.started, attempt.ended
            state.value = attempt.value if attempt.value is not None and math.isfinite(attempt.value) else None
        if attempt is not None and attempt.state == "pruned":
            state.state = "pruned"
        elif attempt is not None and attempt.state == "failed" and self.plan.sweep.is_search:
            state.state, state.reason = "failed", attempt.reason  # it may have finished without a score
        elif self.is_done(cell.run_id):
            state.state = "done"
        elif attempt is not None and attempt.state in ("running", "failed"):
            state.state, state.reason = attempt.state, attempt.reason
            state.worker = attempt.worker if attempt.state == "running" else None
        return state

    def _keep_earlier_seeds(self, record: SweepRecord, latest: dict[str | None, Attempt]) -> None:
        """Seeds of an earlier command stay in the tables, as far as they were trained and the rows are the same."""
        try:
            earlier = read_record(self.path)
        except DataError:
            return  # none yet, or one to be replaced
        for label, by_seed in record.rows.items():
            before = earlier.rows.get(label, {})
            if any(before.get(seed, run_id) != run_id for seed, run_id in by_seed.items()):
                return  # the sweep's definition or its command has changed
        for label, by_seed in record.rows.items():
            today = [_settings(record.runs[run_id]) for run_id in by_seed.values()]
            for seed, run_id in earlier.rows.get(label, {}).items():
                known = earlier.runs[run_id]
                if seed in by_seed or _settings(known) not in today:
                    continue
                state = self._again(known, latest)
                if state.state != "waiting":
                    by_seed[seed] = run_id
                    record.runs.setdefault(run_id, state)
                    if known.needs in earlier.runs:
                        record.runs.setdefault(known.needs, self._again(earlier.runs[known.needs], latest))
        record.seeds = sorted({seed for by_seed in record.rows.values() for seed in by_seed} | set(record.seeds))

    def _again(self, known: RunState, latest: dict[str | None, Attempt]) -> RunState:
        """Where a run of an earlier record stands now."""
        cell = Cell(known.run_id, known.overrides, [], known.seed, known.label, known.needs)
        return self._state(cell, latest.get(known.run_id))


def _settings(run: RunState) -> set[str]:
    """What a run is, whatever its seed; all are of one scale."""
    return {override for override in run.overrides if not is_of(override, ("seed", "scale"))}


def cell_from(content: dict) -> Cell:
    """A cell as a trial keeps it."""
    return Cell(machine=[], **content)
