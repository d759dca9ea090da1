"""Trains what a plan says: workers that take a cell each, train it as a process, and note what became of it."""

from __future__ import annotations

import logging
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TypeVar

from optuna.trial import Trial

from src.errors import HorizonError
from src.report.sweep_record import SweepRecord
from src.sweep.launcher import Ended, Launcher, Stop
from src.sweep.plan import Cell, Plan
from src.sweep.progress import progress_line
from src.sweep.publisher import Keeper
from src.sweep.run_status import is_busy, is_finished, read_score
from src.sweep.sweep_study import Attempt, CellEndedError, DatabaseError, SweepStudy

logger = logging.getLogger(__name__)

Result = TypeVar("Result")

IDLE_S = 1.0
"""Between two looks of a worker that has nothing to do."""
PROGRESS_EVERY_S = 60.0
RECORD_EVERY_S = 20.0
AWAY_S = 900.0
"""How long a running sweep waits for its database; runs that train go on meanwhile. At the start it waits for none."""
AWAY_RETRY_S = 5.0
IMPATIENT_AFTER_S = 2.0
"""A second Ctrl-C this long after the first ends everything at once; launchers repeat a signal within milliseconds."""
MOST_INTERRUPTIONS = 3
"""A run that ends so often as if interrupted, while nobody stopped the sweep, has failed."""


class Runner:
    """One call of `python -m src.sweep` over a planned sweep; others may work on the same study."""

    def __init__(
        self,
        plan: Plan,
        study: SweepStudy,
        keeper: Keeper,
        launcher: Launcher,
        publish: Callable[[Path], object],
    ) -> None:
        self.plan, self.study, self.keeper, self.launcher, self.publish = plan, study, keeper, launcher, publish
        self.outputs = keeper.outputs
        self.stop = Stop()
        self._published: set[str] = set()
        self._interruptions: Counter[str] = Counter()
        self._broken: list[BaseException] = []
        self._first_own = 0  # number of the first trial since this call began

    def run(self) -> SweepRecord:
        """Work until every cell is done or has failed, or a signal comes. Returns the record of that moment."""
        with self._listening():
            with self.study.lock():
                self._report_dead(self.study.clear_dead())
                self._first_own = len(self.study.attempts())
            self.publish_done()
            self._show(self.keeper.write())
            workers = [threading.Thread(target=self._work, args=(index,)) for index in range(self.launcher.workers)]
            for worker in workers:
                worker.start()
            told = written = time.monotonic()
            told_to_stop = False
            while any(worker.is_alive() for worker in workers):
                time.sleep(0.1)
                if self.stop.requested and not told_to_stop:
                    told_to_stop = True
                    logger.info("stopping: runs write a checkpoint and end; Ctrl-C again ends them at once")
                if time.monotonic() - written > RECORD_EVERY_S and not self._broken:
                    written = time.monotonic()
                    record = self._guarded(self.keeper.write)
                    if record is not None and written - told > PROGRESS_EVERY_S:
                        told = written
                        self._show(record)
            if self._broken:
                raise self._broken[0]
            self._patiently(self.publish_done)
            return self._patiently(self.keeper.write)

    def publish_done(self, strictly: bool = False) -> None:
        """Put the results of finished runs, whoever trained them, where tables find them.

        What cannot be written is told, and with `strictly` raises OSError.
        """
        for cell in self.cells():
            if self.keeper.is_done(cell.run_id) and cell.run_id not in self._published:
                self._publish(cell.run_id, strictly)

    def cells(self) -> list[Cell]:
        """Every run of the sweep, as far as known."""
        return list(self.plan.cells.values())

    def _publish(self, run_id: str, strictly: bool = False) -> None:
        """Publish one result; a broken file or a full disk costs that result only, not the sweep."""
        try:
            self.publish(self.outputs / run_id)
            self._published.add(run_id)
        except (HorizonError, OSError) as error:
            logger.warning("the result of %s could not be published: %s", run_id, error)
            if strictly and isinstance(error, OSError):
                raise

    # ---------------------------------------------------------------- a worker

    def _work(self, worker: int) -> None:
        try:
            while not self.stop.requested and self._patiently(partial(self._step, worker)):
                pass
        except BaseException as error:
            self._broken.append(error)
            self.stop.requested = True

    def _patiently(self, action: Callable[[], Result]) -> Result:
        """What needs the database, again and again while it is away. Raises DatabaseError when it stays away."""
        since = None
        while True:
            try:
                return action()
            except DatabaseError as error:
                now = time.monotonic()
                if self.stop.requested or (since is not None and now - since > AWAY_S):
                    raise
                if since is None:
                    since = now
                    logger.warning("%s; trying again for %.0f minutes", error, AWAY_S / 60)
            time.sleep(AWAY_RETRY_S)
            self.study.reconnect()

    def _step(self, worker: int) -> bool:
        """Take and train one cell, or wait a little. False when nothing is left for anyone."""
        with self.study.lock() as hold:
            self._report_dead(self.study.clear_dead())
            cell, settled = self._next(self.study.attempts())
            if cell is not None:
                attrs = {"run_id": cell.run_id, "label": cell.label, "seed": cell.seed, "overrides": cell.overrides}
                self.study.take(hold, lambda trial: self._train(cell, worker, trial), attrs=attrs, params={})
        if cell is not None:
            self._guarded(self.keeper.write)
            return True
        if not settled:
            time.sleep(IDLE_S)
        return not settled

    def _next(self, attempts: list[Attempt]) -> tuple[Cell | None, bool]:
        """(the next cell to train, whether all are done or have failed); the lock is held."""
        latest = {attempt.run_id: attempt for attempt in attempts if attempt.run_id is not None}
        failed: dict[str, str] = {}
        settled = True
        for cell in self.plan.cells.values():  # what is needed stands before what needs it
            attempt = latest.get(cell.run_id)
            if self.keeper.is_done(cell.run_id):
                continue
            if attempt is not None and attempt.state == "failed" and attempt.number >= self._first_own:
                failed[cell.run_id] = attempt.reason or ""
                continue
            if attempt is not None and attempt.state == "running":
                settled = False
                continue
            if cell.needs in failed:
                reason = f"{cell.needs}, which it starts from, failed: {failed[cell.needs]}"
                attrs = {"run_id": cell.run_id, "label": cell.label, "seed": cell.seed, "overrides": cell.overrides}
                self.study.add_failed(attrs, reason)
                failed[cell.run_id] = reason
                continue
            settled = False
            if cell.needs is None or self.keeper.is_done(cell.needs):
                return cell, False
        return None, settled

    def _train(self, cell: Cell, worker: int, trial: Trial) -> float:
        """Train a cell that is taken; its score. Raises CellEndedError when there is none."""
        self._guarded(self.keeper.write)
        ended = self.train(cell, worker)
        if ended is not None:
            if ended.reason:
                self.study.note(trial, "reason", ended.reason)
            raise CellEndedError(ended.reason)
        return read_score(self.outputs / cell.run_id, "mAP") or 0.0

    def train(self, cell: Cell, worker: int, watch: Callable[[], bool] | None = None) -> Ended | None:
        """Bring one run to its end, here or by whoever has it: None when done, else how it ended.

        The reason is empty where it was interrupted and can go on.
        """
        folder = self.outputs / cell.run_id
        while True:
            self._wait_for_others(cell, folder)
            if self.keeper.is_done(cell.run_id):
                return None
            if self.stop.requested:
                return Ended(0, "", told=True)
            logger.info("%s: started %s", name_of(cell), cell.run_id)
            began = time.monotonic()
            ended = self.launcher.run(cell, worker, self.stop, watch)
            if not ended.busy:
                break
        seconds = time.monotonic() - began
        if ended.interrupted and not self.keeper.is_done(cell.run_id):
            self._interruptions[cell.run_id] += not ended.told
            if self._interruptions[cell.run_id] < MOST_INTERRUPTIONS:
                logger.info("%s: interrupted after %.0f s; it can go on", name_of(cell), seconds)
                return replace(ended, reason="")
        reason = ended.reason
        if not reason and not is_finished(folder):
            reason = f"it ended with exit code 0, but {folder} has no run.json and metrics.json"
        elif not reason and not self.keeper.is_done(cell.run_id):
            reason = f"{folder / 'metrics.json'} has no finite mAP"
        if reason:
            logger.warning("%s: FAILED after %.0f s: %s; log: %s", name_of(cell), seconds, reason, self._log(cell))
            return replace(ended, reason=reason)
        score = read_score(folder, "mAP") or 0.0
        logger.info("%s: done after %.0f s, mAP %.1f %%", name_of(cell), seconds, 100 * score)
        self._publish(cell.run_id)
        return None

    def _log(self, cell: Cell) -> Path:
        return self.launcher.log_of(cell.run_id)

    def _wait_for_others(self, cell: Cell, folder: Path) -> None:
        """Wait while a process that is none of the study's trains the run."""
        said = False
        while is_busy(folder) and not self.stop.requested:
            if not said:
                logger.info("%s: another process is training %s; waiting for it", name_of(cell), cell.run_id)
                said = True
            time.sleep(IDLE_S)

    # ---------------------------------------------------------------- around

    def _guarded(self, action: Callable[[], SweepRecord]) -> SweepRecord | None:
        """What only reports must not end a run that trains; the next step of a worker meets the same fault."""
        try:
            return action()
        except HorizonError as error:
            logger.warning("%s", error)
            return None

    def _report_dead(self, dead: list[Attempt]) -> None:
        for attempt in dead:
            if attempt.run_id is not None:
                logger.warning("worker %s is gone; %s is free again", attempt.worker, attempt.run_id)

    def _show(self, record: SweepRecord) -> None:
        logger.info("%s", progress_line(record, self.outputs, self.launcher.workers))

    @contextmanager
    def _listening(self) -> Iterator[None]:
        """Take Ctrl-C and SIGTERM as the wish to stop after checkpoints; a later second Ctrl-C stops at once."""
        first: list[float] = []

        def request(number: int, frame: FrameType | None) -> None:
            first.append(time.monotonic())
            if not self.stop.requested:
                self.stop.requested = True
            elif number == signal.SIGINT and first[-1] - first[0] > IMPATIENT_AFTER_S:
                self.stop.at_once = True

        def missed(args: threading.ExceptHookArgs) -> None:  # of Optuna's heartbeat threads; ours keep their errors
            logger.warning("the database of the sweep did not take a heartbeat (%s)", args.exc_type.__name__)

        hook, threading.excepthook = threading.excepthook, missed
        before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        for number, handler in before.items():
            if handler is not signal.SIG_IGN:  # a shell's background job ignores Ctrl-C
                signal.signal(number, request)
        try:
            yield
        finally:
            threading.excepthook = hook
            for number, handler in before.items():
                signal.signal(number, handler)


def name_of(cell: Cell) -> str:
    """A run as people know it."""
    return f"[{cell.label}, seed {cell.seed}]"
