"""Searches: a sampler chooses each run from the search space of a sweep's file; a pruner ends bad ones early."""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import optuna
from optuna.trial import Trial

from src.errors import DivergedError, HorizonError
from src.report.sweep_file import DimensionConfig
from src.sweep.plan import Identify, RunSpec, join_overrides, run_specs_of, split_machine
from src.sweep.run_status import read_score, read_validations
from src.sweep.runner import Runner, title_of
from src.sweep.sweep_study import SweepStudy, SweepTrial, TrialEndedError, trials_begun

logger = logging.getLogger(__name__)

STARTUP_TRIALS = 5
"""Complete runs before any is pruned or chosen by the model of the sampler."""


@dataclass(eq=False)
class Search(Runner):
    """A runner whose runs are chosen by TPE and pruned by the median of the earlier runs' validations."""

    common: list[str]  # overrides of every run
    identify: Identify

    def __post_init__(self) -> None:
        super().__post_init__()
        self.sweep = self.plan.sweep

    def specs(self) -> list[RunSpec]:
        """Every run that trials have chosen, each once."""
        contents = [content for trial in self.study.trials() for content in trial.attrs.get("run_specs", [])]
        return list({content["run_id"]: RunSpec(**content) for content in contents}.values())

    # ---------------------------------------------------------------- a worker

    def _take_next(self, lock: TextIO, worker: int) -> tuple[bool, bool]:
        trials = self.study.trials()
        resumed, new, settled = self._next_trial(trials)
        retry = {}
        if resumed is not None:
            retry = {"retry_of": resumed.number, "first": resumed.attrs.get("first", resumed.number)}
        if resumed is not None or new:
            self.study.take(
                lock,
                lambda trial: self._try(trial, worker),
                choose=self._choose,
                attrs=retry,
                params=resumed.params if resumed is not None else None,
                sampler=self._sampler(len(trials)),
                pruner=optuna.pruners.MedianPruner(n_startup_trials=STARTUP_TRIALS),
            )
        return resumed is not None or new, settled

    def _next_trial(self, trials: list[SweepTrial]) -> tuple[SweepTrial | None, bool, bool]:
        """(a trial to resume, whether to make a new one, whether all have ended); the lock is held."""
        begun = [trial for trial in trials if trial.run_id is not None]
        retried = {trial.attrs.get("retry_of") for trial in trials}
        for trial in begun:
            # Divergence is conclusive; any other failure of an earlier call is retried.
            retry = trial.state == "failed" and trial.number < self._first_own and not trial.attrs.get("conclusive")
            if (trial.state == "interrupted" or retry) and trial.number not in retried:
                return trial, False, False
        if trials_begun(trials) < self.sweep.trials:
            return None, True, False
        return None, False, not any(trial.state == "running" for trial in trials)

    def _sampler(self, number: int) -> optuna.samplers.BaseSampler:
        """Seeded by the number of the trial, so that no two workers draw the same and a search can be repeated."""
        seed = self.plan.seeds[0] * 100_003 + number
        with_defaults = {"n_startup_trials": STARTUP_TRIALS, "constant_liar": True}
        return optuna.samplers.TPESampler(seed=seed, **with_defaults)

    def _choose(self, trial: Trial) -> None:
        """Draw the values and store the runs they resolve to; the lock is held."""
        chosen = [f"{key}={_draw(trial, key, space)}" for key, space in self.sweep.space.items()]
        seed = self.plan.seeds[0]
        overrides = join_overrides(self.sweep.overrides, self.common, chosen, [f"seed={seed}"])
        label = f"trial {trial.user_attrs.get('first', trial.number)}"
        try:
            specs = run_specs_of(overrides, seed, label, self.identify)
        except HorizonError as error:
            specs = [RunSpec(f"invalid-{trial.number}", overrides, seed, label)]
            trial.set_user_attr("invalid", str(error))
        stored = [spec.stored for spec in specs]
        for key, value in {"run_id": specs[-1].run_id, "chosen": chosen, "run_specs": stored}.items():
            trial.set_user_attr(key, value)

    def _try(self, trial: Trial, worker: int) -> float:
        """Train what a trial starts from and the trial's run; its objective. Raises TrialPruned and TrialEndedError."""
        attrs = trial.user_attrs
        if "invalid" in attrs:
            self._fail(trial, attrs["invalid"], conclusive=True)
        self._logging_errors(self.writer.write)
        machine = split_machine(join_overrides(self.sweep.overrides, self.common))[1]
        *sources, spec = [RunSpec(**content, machine=machine) for content in attrs["run_specs"]]
        for source in sources:
            status = self.train(source, worker)
            if status is not None:
                self._fail(trial, status.reason and f"{source.run_id}, which it starts from, failed: {status.reason}")
        watch = PruningWatch(self.study, trial, self.outputs / spec.run_id, self.sweep.objective)
        status = self.train(spec, worker, watch)
        watch()  # validations since the last poll: later trials are compared with all of them
        if watch.pruned and not self.writer.is_done(spec.run_id):
            self.study.set_attr(trial, "value", watch.last)
            logger.info("%s: pruned, val/%s %.4f", title_of(spec), self.sweep.objective, watch.last)
            raise optuna.TrialPruned
        if status is not None:
            self._fail(trial, status.reason, conclusive=status.code == DivergedError.exit_code)
        value = read_score(self.outputs / spec.run_id, self.sweep.objective)
        if value is None:
            self._fail(trial, f"metrics.json has no finite {self.sweep.objective}", conclusive=True)
        return value

    def _fail(self, trial: Trial, reason: str, conclusive: bool = False) -> None:
        """End the trial; with an empty reason it is to be resumed. A `conclusive` failure is never retried."""
        if reason:
            self.study.set_attr(trial, "reason", reason)
            self.study.set_attr(trial, "conclusive", conclusive)
        raise TrialEndedError(reason)


class PruningWatch:
    """Reports the validations of a run to the pruner as they come; returns whether to end the run."""

    def __init__(self, study: SweepStudy, trial: Trial, folder: Path, metric: str) -> None:
        self._study, self._trial, self._folder, self._metric = study, trial, folder, metric
        self._seen: set[int] = set()
        self._changed = 0
        self.last = 0.0
        self.pruned = False

    def __call__(self) -> bool:
        try:
            changed = (self._folder / "metrics.csv").stat().st_mtime_ns
        except OSError:
            return self.pruned
        if changed == self._changed:
            return self.pruned
        self._changed = changed
        for epoch, value in read_validations(self._folder, self._metric).items():
            if epoch in self._seen:
                continue
            try:
                self.pruned = self._study.report(self._trial, value, epoch) or self.pruned
            except HorizonError as error:  # a short database outage must not end a run that trains
                logger.warning("%s", error)
                self._changed = 0
                return self.pruned
            self._seen.add(epoch)
            self.last = value
        return self.pruned


def _draw(trial: Trial, key: str, space: DimensionConfig) -> str:
    """A value of the sampler, written as in an override."""
    if space.choices is not None:
        value = trial.suggest_categorical(key, space.choices)
        return json.dumps(value) if value is None or isinstance(value, bool) else str(value)
    return f"{trial.suggest_float(key, space.low, space.high, log=space.log):.4g}"
