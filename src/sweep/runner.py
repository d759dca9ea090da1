"""Trains the runs of a plan: each worker takes a run spec, trains it as a process, and records its outcome."""

from __future__ import annotations

import logging
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TextIO, TypeVar

from optuna.trial import Trial

from src.errors import HorizonError
from src.reliability.command import INTERRUPT_GRACE_S, handling_signals
from src.report.metric_names import metric_of
from src.report.results import is_finished
from src.report.sweep_record import SweepRecord
from src.report.time_left import progress_of
from src.sweep.launcher import ExitStatus, Launcher, StopRequest
from src.sweep.plan import Plan, RunSpec
from src.sweep.record_writer import RecordWriter
from src.sweep.run_status import is_locked, read_headline, read_score
from src.sweep.sweep_study import DatabaseError, SweepStudy, SweepTrial, TrialEndedError

logger = logging.getLogger(__name__)

Result = TypeVar("Result")

POLL_S = 1.0
"""How long a worker without work waits before it looks again."""
PROGRESS_EVERY_S = 60.0
RECORD_EVERY_S = 20.0
DATABASE_TIMEOUT_S = 900.0
"""How long a running sweep waits for its database while its runs train; at the start it does not wait."""
DATABASE_RETRY_S = 5.0
MOST_INTERRUPTIONS = 3
"""A run that ends this often as if interrupted, while nobody stopped the sweep, has failed."""


@dataclass(eq=False)
class Runner:
    """One call of `python -m src.sweep` over a planned sweep; others may work on the same study."""

    plan: Plan
    study: SweepStudy
    writer: RecordWriter
    launcher: Launcher
    publish: Callable[[Path], object]  # a finished run's folder
    failed: dict[str, str] = field(default_factory=dict, kw_only=True)  # reasons by run id; not trained again

    def __post_init__(self) -> None:
        self.outputs = self.writer.outputs
        self.stop = StopRequest()
        self._published: set[str] = set()
        self._interruptions: Counter[str] = Counter()
        self._worker_errors: list[BaseException] = []
        self._first_own = 0  # number of the first trial since this call began

    def run(self) -> SweepRecord:
        """Work until every run is done or has failed, or a signal comes. Returns the final record."""
        with self._handling_signals():
            with self.study.lock():
                self.study.release_dead()
                self._first_own = len(self.study.trials())
            self.publish_and_list_faults()
            self._show(self.writer.write())
            workers = [threading.Thread(target=self._work, args=(index,)) for index in range(self.launcher.workers)]
            for worker in workers:
                worker.start()
            shown = written = time.monotonic()
            stop_logged = False
            while any(worker.is_alive() for worker in workers):
                time.sleep(0.1)
                if self.stop.requested and not stop_logged:
                    stop_logged = True
                    logger.info("stopping: runs write a checkpoint and end; Ctrl-C again kills them")
                if time.monotonic() - written > RECORD_EVERY_S and not self._worker_errors:
                    written = time.monotonic()
                    record = self._logging_errors(self.writer.write)
                    if record is not None and written - shown > PROGRESS_EVERY_S:
                        shown = written
                        self._show(record)
            if self._worker_errors:
                raise self._worker_errors[0]
            self._with_retries(self.publish_and_list_faults)
            return self._with_retries(self.writer.write)

    def publish_and_list_faults(self, strictly: bool = False) -> list[str]:
        """Write the results of finished runs, whoever trained them, to where tables find them.

        Runs whose files are broken are logged and returned, in a line each; so is a disk that does not take a result,
        which with `strictly` raises OSError.
        """
        due = [spec.run_id for spec in self.specs() if self.writer.is_done(spec.run_id)]
        due = [run_id for run_id in due if run_id not in self._published | self.plan.published]
        return [fault for run_id in due if (fault := self._publish(run_id, strictly)) is not None]

    def specs(self) -> list[RunSpec]:
        """The runs of the sweep known so far."""
        return list(self.plan.specs.values())

    def _publish(self, run_id: str, strictly: bool = False) -> str | None:
        """Publish one result; a broken file or a full disk costs that result only, not the sweep, and is returned."""
        try:
            self.publish(self.outputs / run_id)
        except (HorizonError, OSError) as error:
            fault = f"the result of {run_id} could not be published: {error}"
            logger.warning("%s", fault)
            if strictly and isinstance(error, OSError):
                raise
            return fault
        self._published.add(run_id)
        return None

    # ---------------------------------------------------------------- a worker

    def _work(self, worker: int) -> None:
        try:
            while not self.stop.requested and self._with_retries(partial(self._step, worker)):
                pass
        except BaseException as error:
            self._worker_errors.append(error)
            self.stop.requested = True

    def _with_retries(self, action: Callable[[], Result]) -> Result:
        """Retry an action while the database is away. Raises DatabaseError when it stays away."""
        since = None
        while True:
            try:
                return action()
            except DatabaseError as error:
                now = time.monotonic()
                if self.stop.requested or (since is not None and now - since > DATABASE_TIMEOUT_S):
                    raise
                if since is None:
                    since = now
                    logger.warning("%s; retrying for %.0f minutes", error, DATABASE_TIMEOUT_S / 60)
            time.sleep(DATABASE_RETRY_S)
            self.study.reconnect()

    def _step(self, worker: int) -> bool:
        """Take and train one run, or wait a little. False when no run is left for any worker."""
        with self.study.lock() as lock:
            self.study.release_dead()
            took, settled = self._take_next(lock, worker)
        if took:
            self._logging_errors(self.writer.write)
        elif not settled:
            time.sleep(POLL_S)
        return took or not settled

    def _take_next(self, lock: TextIO, worker: int) -> tuple[bool, bool]:
        """Train the next run, whose taking releases the lock: (whether there was one, else whether all have ended)."""
        spec, settled = self._next(self.study.trials())
        if spec is not None:
            self.study.take(lock, lambda trial: self._train(spec, worker, trial), attrs=spec.stored, params={})
        return spec is not None, settled

    def _next(self, trials: list[SweepTrial]) -> tuple[RunSpec | None, bool]:
        """(the next run to train, whether all are done or have failed); the lock is held."""
        latest = {trial.run_id: trial for trial in trials if trial.run_id is not None}
        settled = True
        for spec in self.plan.specs.values():  # in training order: a source comes before the runs that start from it
            trial = latest.get(spec.run_id)
            if self.writer.is_done(spec.run_id):
                self.failed.pop(spec.run_id, None)
                continue
            if trial is not None and trial.state == "failed" and trial.number >= self._first_own:
                self.failed[spec.run_id] = trial.reason or ""
                continue
            if trial is not None and trial.state == "running":
                self.failed.pop(spec.run_id, None)
                settled = False
                continue
            reason = self.failed.get(spec.run_id)
            if reason is None and spec.needs in self.failed:
                reason = f"{spec.needs}, which it starts from, failed: {self.failed[spec.needs]}"
            if reason is not None:
                self.study.add_failed(spec.stored, reason)
                self.failed[spec.run_id] = reason
                continue
            settled = False
            if spec.needs is None or self.writer.is_done(spec.needs):
                return spec, False
        return None, settled

    def _train(self, spec: RunSpec, worker: int, trial: Trial) -> float:
        """Train a run that is taken; its score. Raises TrialEndedError when there is none."""
        self._logging_errors(self.writer.write)
        status = self.train(spec, worker)
        if status is not None:
            if status.reason:
                self.study.set_attr(trial, "reason", status.reason)
            raise TrialEndedError(status.reason)
        folder = self.outputs / spec.run_id
        score = read_score(folder, read_headline(folder))
        if score is None:  # its files are gone since
            raise TrialEndedError(f"{folder} holds no score")
        return score

    def train(self, spec: RunSpec, worker: int, watch: Callable[[], bool] | None = None) -> ExitStatus | None:
        """Train one run, or wait for whoever trains it: None when it is done, else the exit status.

        The reason is empty where it was interrupted and can be resumed.
        """
        folder = self.outputs / spec.run_id
        while True:
            self._wait_for_others(spec, folder)
            if self.writer.is_done(spec.run_id):
                return None
            if self.stop.requested:
                return ExitStatus(0, "", stop_requested=True)
            logger.info("%s: started %s", title_of(spec), spec.run_id)
            began = time.monotonic()
            status = self.launcher.run(spec, worker, self.stop, watch)
            if not status.busy:
                break
        seconds = time.monotonic() - began
        if status.interrupted and not self.writer.is_done(spec.run_id):
            self._interruptions[spec.run_id] += not status.stop_requested
            if self._interruptions[spec.run_id] < MOST_INTERRUPTIONS:
                logger.info("%s: interrupted after %.0f s; it can be resumed", title_of(spec), seconds)
                return replace(status, reason="")
        # A signal may come when everything is written, as to a search's run that is ended early in its last moment.
        reason = "" if status.interrupted and self.writer.is_done(spec.run_id) else status.reason
        if not reason and not is_finished(folder):
            reason = f"it ended with exit code 0, but {folder} has no run.json and metrics.json"
        elif not reason and not self.writer.is_done(spec.run_id):
            reason = f"{folder / 'metrics.json'} has no finite {read_headline(folder)}"
        if reason:
            log = self.launcher.log_of(spec.run_id)
            logger.warning("%s: FAILED after %.0f s: %s; log: %s", title_of(spec), seconds, reason, log)
            return replace(status, reason=reason)
        name = read_headline(folder)
        metric = metric_of(name)
        score = f"{metric.scale * (read_score(folder, name) or 0.0):.{metric.digits}f} {metric.unit}".rstrip()
        logger.info("%s: done after %.0f s, %s %s", title_of(spec), seconds, metric.title, score)
        self._publish(spec.run_id)
        return None

    def _wait_for_others(self, spec: RunSpec, folder: Path) -> None:
        """Wait while a process outside the study trains the run."""
        logged = False
        while is_locked(folder) and not self.stop.requested:
            if not logged:
                logger.info("%s: another process is training %s; waiting for it", title_of(spec), spec.run_id)
                logged = True
            time.sleep(POLL_S)

    # ---------------------------------------------------------------- around

    def _logging_errors(self, action: Callable[[], SweepRecord]) -> SweepRecord | None:
        """Reporting must not end a run that trains; the next step of a worker meets the same error."""
        try:
            return action()
        except HorizonError as error:
            logger.warning("%s", error)
            return None

    def _show(self, record: SweepRecord) -> None:
        logger.info("%s", progress_of(record, self.launcher.workers, time.time()))

    @contextmanager
    def _handling_signals(self) -> Iterator[None]:
        """Ctrl-C and SIGTERM request a stop after checkpoints; a later second Ctrl-C kills the runs."""
        first: list[float] = []

        def request(number: int, frame: FrameType | None) -> None:
            first.append(time.monotonic())
            if not self.stop.requested:
                self.stop.requested = True
            elif number == signal.SIGINT and first[-1] - first[0] > INTERRUPT_GRACE_S:
                self.stop.at_once = True

        def log_missed(args: threading.ExceptHookArgs) -> None:  # of Optuna's heartbeat threads; ours keep their errors
            logger.warning("the database of the sweep did not take a heartbeat (%s)", args.exc_type.__name__)

        hook, threading.excepthook = threading.excepthook, log_missed
        try:
            with handling_signals(request, signal.SIGINT, signal.SIGTERM):
                yield
        finally:
            threading.excepthook = hook


def title_of(spec: RunSpec) -> str:
    """A run's name in messages."""
    return f"[{spec.label}, seed {spec.seed}]"
