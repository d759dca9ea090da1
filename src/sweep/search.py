"""Searches: a sampler chooses each run from the space of a sweep's file, and ends early what promises little."""

from __future__ import annotations

import json
import logging
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import optuna
from optuna.trial import Trial

from src.errors import DivergedError, HorizonError
from src.report.sweep_file import DimensionConfig
from src.sweep.plan import Cell, Identify, cells_of, join_overrides, split_machine
from src.sweep.publisher import cell_from
from src.sweep.run_status import read_score, read_validations
from src.sweep.runner import IDLE_S, Runner, name_of
from src.sweep.sweep_study import Attempt, CellEndedError, SweepStudy, trials_begun

logger = logging.getLogger(__name__)

STARTUP_TRIALS = 5
"""Complete runs before any is ended early or chosen by the model of the sampler."""


class Search(Runner):
    """A runner whose cells are chosen by TPE and pruned by the median of the earlier runs' validations."""

    def __init__(self, *runner: Any, common: list[str], identify: Identify) -> None:
        super().__init__(*runner)
        self._common, self._identify = common, identify
        self.sweep = self.plan.sweep

    def cells(self) -> list[Cell]:
        """Every run that trials have chosen, each once."""
        contents = [content for attempt in self.study.attempts() for content in attempt.attrs.get("cells", [])]
        return list({content["run_id"]: cell_from(content) for content in contents}.values())

    def best(self) -> Attempt | None:
        """The trial with the best objective so far."""
        done = [attempt for attempt in self.study.attempts() if attempt.state == "done" and attempt.value is not None]
        return max(done, key=lambda attempt: attempt.value or 0.0, default=None)

    # ---------------------------------------------------------------- a worker

    def _step(self, worker: int) -> bool:
        with self.study.lock() as hold:
            self._report_dead(self.study.clear_dead())
            attempts = self.study.attempts()
            again, new, settled = self._next_trial(attempts)
            if again is not None or new:
                attrs = {} if again is None else {"retry_of": again.number, "first": _first(again)}
                self.study.take(
                    hold,
                    lambda trial: self._try(trial, worker),
                    choose=self._choose,
                    attrs=attrs,
                    params=again.params if again is not None else None,
                    sampler=self._sampler(len(attempts)),
                    pruner=optuna.pruners.MedianPruner(n_startup_trials=STARTUP_TRIALS),
                )
        if again is not None or new:
            self._guarded(self.keeper.write)
            return True
        if not settled:
            time.sleep(IDLE_S)
        return not settled

    def _next_trial(self, attempts: list[Attempt]) -> tuple[Attempt | None, bool, bool]:
        """(a trial to go on with, whether to make a new one, whether all have ended); the lock is held."""
        begun = [attempt for attempt in attempts if attempt.run_id is not None]
        tried_again = {attempt.attrs.get("retry_of") for attempt in attempts}
        for attempt in begun:
            # Diverged is an answer; any other failure of an earlier call is worth another try.
            retry = attempt.state == "failed" and attempt.number < self._first_own and not attempt.attrs.get("answer")
            if (attempt.state == "interrupted" or retry) and attempt.number not in tried_again:
                return attempt, False, False
        if trials_begun(attempts) < self.sweep.trials:
            return None, True, False
        return None, False, not any(attempt.state == "running" for attempt in attempts)

    def _sampler(self, number: int) -> optuna.samplers.BaseSampler:
        """Seeded by the number of the trial, so that no two workers draw the same and a search can be repeated."""
        seed = self.plan.seeds[0] * 100_003 + number
        with_defaults = {"n_startup_trials": STARTUP_TRIALS, "constant_liar": True}
        return optuna.samplers.TPESampler(seed=seed, **with_defaults)

    def _choose(self, trial: Trial) -> None:
        """Draw the values and note the runs they come to; the lock is held."""
        chosen = [f"{key}={_draw(trial, key, space)}" for key, space in self.sweep.space.items()]
        seed = self.plan.seeds[0]
        overrides = join_overrides(self.sweep.overrides, self._common, chosen, [f"seed={seed}"])
        label = f"trial {trial.user_attrs.get('first', trial.number)}"
        try:
            cells = cells_of(overrides, seed, label, self._identify)
        except HorizonError as error:
            cells = [Cell(f"impossible-{trial.number}", overrides, [], seed, label, None)]
            trial.set_user_attr("impossible", str(error))
        kept = [asdict(cell) for cell in cells]
        for content in kept:
            content.pop("machine")
        for key, value in {"run_id": cells[-1].run_id, "chosen": chosen, "cells": kept}.items():
            trial.set_user_attr(key, value)

    def _try(self, trial: Trial, worker: int) -> float:
        """Train what a trial starts from and the trial's run; its objective. Raises TrialPruned and CellEndedError."""
        attrs = trial.user_attrs
        if "impossible" in attrs:
            self._fail(trial, attrs["impossible"], answer=True)
        self._guarded(self.keeper.write)
        machine = split_machine(join_overrides(self.sweep.overrides, self._common))[1]
        *sources, cell = [replace(cell_from(content), machine=machine) for content in attrs["cells"]]
        for source in sources:
            ended = self.train(source, worker)
            if ended is not None:
                self._fail(trial, ended.reason and f"{source.run_id}, which it starts from, failed: {ended.reason}")
        watch = _Watch(self.study, trial, self.outputs / cell.run_id, self.sweep.objective)
        ended = self.train(cell, worker, watch)
        watch()  # what came since the last look: later trials are compared with all of it
        if watch.pruned and not self.keeper.is_done(cell.run_id):
            self.study.note(trial, "value", watch.last)
            logger.info("%s: pruned, val/%s %.4f", name_of(cell), self.sweep.objective, watch.last)
            raise optuna.TrialPruned
        if ended is not None:
            self._fail(trial, ended.reason, answer=ended.code == DivergedError.exit_code)
        value = read_score(self.outputs / cell.run_id, self.sweep.objective)
        if value is None:
            self._fail(trial, f"metrics.json has no finite {self.sweep.objective}", answer=True)
        return value

    def _fail(self, trial: Trial, reason: str, answer: bool = False) -> None:
        """End the trial; an empty reason leaves it to be gone on with. `answer`: trying again would show the same."""
        if reason:
            self.study.note(trial, "reason", reason)
            self.study.note(trial, "answer", answer)
        raise CellEndedError(reason)


def _first(attempt: Attempt) -> int:
    """Number of the trial that this one goes on with."""
    return attempt.attrs.get("first", attempt.number)


class _Watch:
    """Looks at the validations of a run as they come, and says when it should be ended."""

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
            except HorizonError as error:  # a database that is away for a moment must not end a run that trains
                logger.warning("%s", error)
                self._changed = 0
                return self.pruned
            self._seen.add(epoch)
            self.last = value
        return self.pruned


def _draw(trial: Trial, key: str, space: DimensionConfig) -> str:
    """A value of the sampler as an override writes it."""
    if space.choices is not None:
        value = trial.suggest_categorical(key, space.choices)
        return json.dumps(value) if value is None or isinstance(value, bool) else str(value)
    return f"{trial.suggest_float(key, space.low, space.high, log=space.log):.4g}"
