"""Writes the record of a sweep from the plan, the trials and the run folders, under the study's lock."""

from __future__ import annotations

import logging
import math
import time
from pathlib import Path

from src.errors import DataError
from src.reliability.passwords import masked
from src.report.results import result_path
from src.report.sweep_record import RunState, SweepRecord, read_record, record_path, write_record
from src.sweep.plan import Plan, RunSpec, without_published
from src.sweep.run_status import is_finished_with_score
from src.sweep.sweep_study import SweepStudy, SweepTrial, trials_begun
from src.training.identity import canonical, is_of

logger = logging.getLogger(__name__)


class RecordWriter:
    """Writes `reports/sweeps/<stem>.json` of a plan; several runners may write the same one."""

    def __init__(
        self, plan: Plan, study: SweepStudy, command: str, outputs: Path, reports: Path, published: bool = False
    ) -> None:
        self.plan, self.study, self.command, self.outputs, self.published = plan, study, command, outputs, published
        self.reports, self.path = reports, record_path(reports, plan.sweep.name, plan.scale, plan.changes)
        self._done: set[str] = set()

    def is_done(self, run_id: str) -> bool:
        """Whether the run is finished and has a score, or counts by its result; a finished run is not checked again."""
        if run_id not in self._done and is_finished_with_score(self.outputs / run_id):
            self._done.add(run_id)
        return run_id in self._done or run_id in self.plan.published

    def write(self) -> SweepRecord:
        """Build and write the current record. A full disk is only logged: finished runs do not depend on it."""
        with self.study.lock():
            record = self._build(self.study.trials())
            try:
                write_record(self.path, record)
            except OSError as error:
                logger.warning("%s could not be written (%s); the sweep continues", self.path, error)
        return record

    def _build(self, trials: list[SweepTrial]) -> SweepRecord:
        latest = {trial.run_id: trial for trial in trials if trial.run_id is not None}
        runs = {spec.run_id: self._state(spec, latest.get(spec.run_id)) for spec in self.plan.specs.values()}
        if self.published:  # results may have come since the plan was made
            there = [run_id for run_id in runs if result_path(self.reports, run_id).is_file()]
            for run_id in without_published(self.plan, there).published:
                runs[run_id].state = "done" if runs[run_id].state == "waiting" else runs[run_id].state
        if self.plan.sweep.is_search:
            for trial in trials:
                for spec in (RunSpec(**content) for content in trial.attrs.get("run_specs", [])):
                    # The source run of a trial has no trial of its own: that trial trains it.
                    own = latest.get(spec.run_id) or (trial if trial.state == "running" else None)
                    runs[spec.run_id] = self._state(spec, own)
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
            trials=trials_begun(trials),
            updated=time.time(),
        )
        self._keep_earlier_seeds(record, latest)
        return record

    def _state(self, spec: RunSpec, trial: SweepTrial | None) -> RunState:
        log = self.study.folder / f"{spec.run_id}.log"
        state = RunState(**spec.stored, log=str(log.relative_to(self.outputs)) if log.is_file() else None)
        if trial is not None:
            state.started, state.ended = trial.started, trial.ended
            state.value = trial.value if trial.value is not None and math.isfinite(trial.value) else None
        if trial is not None and trial.state == "pruned":
            state.state = "pruned"
        elif trial is not None and trial.state == "failed" and self.plan.sweep.is_search:
            state.state, state.reason = "failed", trial.reason  # it may have finished without a score
        elif self.is_done(spec.run_id):
            state.state = "done"
        elif trial is not None and trial.state in ("running", "failed"):
            state.state, state.reason = trial.state, trial.reason
            state.worker = trial.worker if trial.state == "running" else None
        return state

    def _keep_earlier_seeds(self, record: SweepRecord, latest: dict[str | None, SweepTrial]) -> None:
        """Keep trained seeds of an earlier command in the tables, where the rows are the same.

        Trained are those that are finished here, and those of the earlier record whose result is in `reports`.
        """
        try:
            earlier = read_record(self.path)
        except DataError:
            return  # none yet, or one to be replaced
        for label, by_seed in record.rows.items():
            before = earlier.rows.get(label, {})
            if any(before.get(seed, run_id) != run_id for seed, run_id in by_seed.items()):
                continue  # the row's definition has changed
            settings = [_settings(record.runs[run_id]) for run_id in by_seed.values()]
            for seed, run_id in earlier.rows.get(label, {}).items():
                known = earlier.runs[run_id]
                if seed in by_seed or _settings(known) not in settings:
                    continue
                state = self._current_state(known, latest)
                if state.state not in ("waiting", "failed"):  # this command trains neither
                    by_seed[seed] = run_id
                    record.runs.setdefault(run_id, state)
                    if known.needs in earlier.runs:
                        record.runs.setdefault(known.needs, self._current_state(earlier.runs[known.needs], latest))
        record.seeds = sorted({seed for by_seed in record.rows.values() for seed in by_seed} | set(record.seeds))

    def _current_state(self, known: RunState, latest: dict[str | None, SweepTrial]) -> RunState:
        """The present state of a run of an earlier record."""
        spec = RunSpec(known.run_id, known.overrides, known.seed, known.label, known.needs)
        state = self._state(spec, latest.get(known.run_id))
        if state.state == "waiting" and known.state == "done" and result_path(self.reports, known.run_id).is_file():
            return known
        return state


def _settings(run: RunState) -> set[str]:
    """Overrides of a run without what differs by seed: the seed, and the run whose weights it scores."""
    by_seed = f"phase.init_from={run.needs}"
    return {canonical(o) for o in run.overrides if not is_of(o, ("seed", "scale")) and o != by_seed}
