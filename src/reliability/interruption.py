"""Checkpoints inside an epoch, and the end of a run on Ctrl-C or SIGTERM after one."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import lightning as L
from lightning.pytorch.trainer.states import TrainerFn

from src.errors import InterruptedRunError
from src.reliability.command import INTERRUPT_GRACE_S, handling_signals
from src.reliability.metrics_csv import MetricsCSV


class Interruption(L.Callback):
    """Writes `last` every so many steps, before each validation, and when the run is asked to stop.

    A request takes effect before the next step (or validation batch) and on all ranks together, whichever of them got
    the signal; then InterruptedRunError ends the run. Validation batches differ in number between ranks, so that
    several ranks finish theirs first. A second Ctrl-C after the grace period ends the run at once.

    Checkpoints are written before a step rather than after one, because the log's row of a step is written last.
    """

    def __init__(self, last: Path, every_steps: int | None) -> None:
        self.last, self.every_steps = last, every_steps
        self.requested = False
        self.began = False  # whether there were steps left to train
        self._signals: list[signal.Signals] = []
        self._first_signal_s = 0.0
        self._saving = False
        self._saved_step = -1

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Take SIGTERM and SIGINT as requests to stop; the earlier handlers come back afterwards."""
        self.requested = self.began = False
        with handling_signals(self._request, signal.SIGINT, signal.SIGTERM) as self._signals:
            yield

    def _listen(self) -> None:
        # Lightning puts a handler of its own before ours at the start of each fit and validate; on several ranks it
        # would wait for the others inside the handler. The hooks below, which come later, put ours back.
        for number in self._signals:
            signal.signal(number, self._request)

    def _request(self, number: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        if not self.requested:
            self.requested, self._first_signal_s = True, now
        elif number == signal.SIGINT and now - self._first_signal_s > INTERRUPT_GRACE_S:
            raise KeyboardInterrupt

    # ---------------------------------------------------------------- hooks

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Note that steps are left to train; where the run starts, a checkpoint exists or none is needed."""
        self.began = True
        self._listen()
        self._saved_step = trainer.global_step

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Save and stop where due. Before an epoch's first step the last epoch's checkpoint holds everything."""
        stop = self._agreed(trainer)
        due = self.every_steps is not None and trainer.global_step % self.every_steps == 0
        if batch_idx > 0 and (stop or due):
            self._save(trainer)
        if stop:
            self._stop(trainer)

    def on_validation_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Save the steps of the epoch before a validation that may take long."""
        self._listen()
        if trainer.state.fn == TrainerFn.FITTING:
            self._save(trainer)
        if self._agreed(trainer):
            self._stop(trainer)

    def on_validation_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Any, batch_idx: int, dataloader_idx: int = 0
    ) -> None:
        """Stop inside a validation where no other rank would wait for this one."""
        if self.requested and trainer.world_size == 1:
            self._stop(trainer)

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Share a stop request that came after the last step with all ranks."""
        self.requested = self._agreed(trainer)

    def on_save_checkpoint(self, trainer: L.Trainer, pl_module: L.LightningModule, checkpoint: dict[str, Any]) -> None:
        """State the loops' progress so that Lightning resumes exactly here; first sync the log to disk."""
        for own in trainer.loggers:
            if isinstance(own, MetricsCSV):
                if not self._saving and not trainer.validating:
                    self._log_epoch(trainer, own)
                own.sync()
        if not self._saving:
            return
        loops = checkpoint["loops"]["fit_loop"]
        if trainer.validating:
            # As amid a validation batch: the validation is run again as a whole, the training of the epoch is not.
            progress = loops["epoch_loop.val_loop.batch_progress"]
            for counts in (progress["total"], progress["current"]):
                counts.update(ready=1, started=1, processed=0, completed=0)
        else:
            # As at the end of the last step, the place of Lightning's own checkpoints of steps. Before a step, one
            # batch more is under way and the log's step is already counted; Lightning would count both twice.
            progress = loops["epoch_loop.batch_progress"]
            for counts in (progress["total"], progress["current"]):
                done = counts["completed"]
                counts.update(ready=done, started=done, processed=done, completed=done - 1)
            progress["is_last_batch"] = False
            loops["epoch_loop.state_dict"]["_batches_that_stepped"] -= 1

    # ---------------------------------------------------------------- parts

    def _log_epoch(self, trainer: L.Trainer, log: MetricsCSV) -> None:
        """Write the epoch's row before the checkpoint of its end, from which a run resumes; Lightning does after."""
        metrics = trainer._logger_connector.metrics["log"]
        step = trainer.fit_loop.epoch_loop._batches_that_stepped - 1
        log.log_metrics(metrics | {"epoch": trainer.current_epoch}, step)

    def _agreed(self, trainer: L.Trainer) -> bool:
        return trainer.strategy.reduce_boolean_decision(self.requested, all=False)

    def _save(self, trainer: L.Trainer) -> None:
        if trainer.global_step == self._saved_step:
            return
        self._saving = True
        try:
            trainer.save_checkpoint(self.last)
        finally:
            self._saving = False
        self._saved_step = trainer.global_step

    def _stop(self, trainer: L.Trainer) -> None:
        raise InterruptedRunError(
            f"training was stopped after {trainer.global_step} steps; the same command resumes from there"
        )
