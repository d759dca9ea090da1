"""One training: Lightning's Trainer with our checkpoints, log and progress bar."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import EMAWeightAveraging, ModelCheckpoint, WeightAveraging
from lightning.pytorch.loggers.logger import Logger
from lightning.pytorch.plugins.precision import Precision as PrecisionPlugin

from src.data.datamodule import DetectionDataModule
from src.data.frame_loader import dead_workers_named
from src.errors import InterruptedRunError
from src.ops.precision import Precision
from src.ops.products import bfloat16_products
from src.reliability.checkpoints import BEST, LAST, AtomicCheckpointIO, OpenCheckpoint, keep_as
from src.reliability.interruption import Interruption
from src.reliability.metrics_csv import MetricsCSV
from src.reliability.processes import SharedStatistics, build_strategy
from src.training.module import TrainingModule
from src.training.phases import PhaseConfig
from src.training.progress_bar import LossProgressBar
from src.training.run_folder import RunFolder
from src.training.trainer_config import TrainerConfig
from src.training.wandb import WandbConfig, start_wandb

EXPECTED_WARNINGS = (
    ".*resuming from a checkpoint that ended before the epoch ended",  # the sampler knows its place by the step
    ".*recommended to use `self.log.*sync_dist=True",  # everything logged by epoch is the same on all ranks
)


class Bfloat16Products(PrecisionPlugin):
    """Steps of training and validation within `bfloat16_products`."""

    @contextmanager
    def forward_context(self) -> Iterator[None]:
        """Context around forward and backward."""
        with bfloat16_products():
            yield


def precision_plugins(precision: str) -> list[PrecisionPlugin]:
    """Lightning plugins for a precision that Lightning does not have; none for its own."""
    return [Bfloat16Products()] if precision == Precision.PRODUCTS else []


def build_trainer(
    folder: RunFolder,
    config: TrainerConfig,
    phase: PhaseConfig,
    *,
    precision: str,
    ema_decay: float | None,
    loggers: list[Logger],  # of the main process; the others have none
) -> L.Trainer:
    """A Trainer that keeps `last.ckpt` of every epoch and `best.ckpt` by `phase.monitor` in the run's folder.

    The last but one stays as `previous.ckpt`. With `checkpoint_every_steps`, `last.ckpt` is written inside epochs too.
    """
    # Checkpoint names carry no metric: an unquoted `=` in a path cannot be typed after checkpoint=.
    fixed_name = {"dirpath": folder.checkpoints, "auto_insert_metric_name": False, "enable_version_counter": False}
    best, last = Path(BEST).stem, Path(LAST).stem
    interruption = Interruption(folder.checkpoints / LAST, config.checkpoint_every_steps)
    callbacks: list[L.Callback] = [
        ModelCheckpoint(filename=best, monitor=phase.monitor, mode="max", save_top_k=1, **fixed_name),
        ModelCheckpoint(filename=last, save_top_k=1, save_on_train_epoch_end=True, **fixed_name),
        interruption,
        LossProgressBar(refresh_rate=10),
    ]
    if ema_decay is not None:
        callbacks.append(MovingAverage(decay=ema_decay))
    callbacks.append(SharedStatistics())  # behind the moving average
    plugins = precision_plugins(precision)
    return L.Trainer(
        max_epochs=phase.epochs,
        check_val_every_n_epoch=phase.validate_every,
        accelerator=config.accelerator.value,
        devices=config.devices,
        num_nodes=config.num_nodes,
        strategy=build_strategy(*config.processes),
        logger=loggers,
        callbacks=callbacks,
        precision=None if plugins else precision,
        plugins=[*plugins, AtomicCheckpointIO(folder.check_held, fail_fast=lambda: interruption.requested)],
        log_every_n_steps=config.log_every_steps,
        deterministic=config.deterministic,
        num_sanity_val_steps=0,
        use_distributed_sampler=False,  # Lightning's pads validation, so samples would count twice
        default_root_dir=folder.path,
        enable_model_summary=False,
    )


def build_loggers(
    folder: RunFolder,
    resume: OpenCheckpoint | None,
    wandb: WandbConfig | None,
    tree: dict[str, Any] | None = None,  # the run's configuration, for W&B
) -> list[Logger]:
    """metrics.csv always; Weights & Biases where asked for and able to start."""
    step = -1 if resume is None else int(resume.content["global_step"])
    metrics = MetricsCSV(folder.metrics_csv, resume_step=step)
    run = start_wandb(wandb, folder, tree or {}, list(metrics.rows)) if wandb is not None else None
    return [metrics] if run is None else [metrics, run]


def fit(
    trainer: L.Trainer, module: TrainingModule, datamodule: DetectionDataModule, resume: OpenCheckpoint | None
) -> None:
    """Train to the last epoch, from `resume` where given, then validate the final weights into `module.evaluator`.

    Raises InterruptedRunError when stopped from outside; the same command then resumes.
    """
    interruption = next(callback for callback in trainer.callbacks if isinstance(callback, Interruption))
    module.skipped.clear()
    try:
        with interruption.listening(), dead_workers_named(), warnings.catch_warnings():
            for expected in EXPECTED_WARNINGS:
                warnings.filterwarnings("ignore", message=expected)
            trainer.strategy.checkpoint_io.opened = resume
            ckpt_path = None if resume is None else resume.path
            if resume is not None:  # Lightning would forget the best score where the folder has been moved
                for state in resume.content.get("callbacks", {}).values():
                    state.pop("dirpath", None)
            trainer.fit(module, datamodule=datamodule, ckpt_path=ckpt_path, weights_only=True)
            counted = None
            if not interruption.began:  # only the results were missing
                for callback in trainer.callbacks:  # Lightning has restored the weights of the last step
                    if isinstance(callback, WeightAveraging):
                        callback.on_train_end(trainer, module)  # puts the moving average in their place
                if trainer.max_epochs % trainer.check_val_every_n_epoch == 0:
                    trainer.loggers = []  # they have the scores of the last epoch already
                    counted = module.skipped.state()  # and so are its skipped files
                if trainer.max_epochs == 0:
                    trainer.save_checkpoint(interruption.last)  # no epoch's end has
            if module.evaluated_step != trainer.global_step:
                trainer.validate(module, datamodule=datamodule, verbose=False)  # the last epoch was not to be validated
                _keep_best(trainer, interruption.last)
            if counted is not None:
                module.skipped.clear()
                module.skipped.restore([counted])
    except SystemExit as error:  # Lightning's way to end on a KeyboardInterrupt
        raise InterruptedRunError("training was stopped; the same command resumes from the last checkpoint") from error
    if interruption.requested:
        raise InterruptedRunError("stopped after the last step; the same command scores and writes the results")


class MovingAverage(EMAWeightAveraging):
    """Moving average of the weights over the steps that were taken; a skipped one leaves nothing behind."""

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: TrainingModule, *rest: Any) -> None:
        """Take the weights into the average, unless the step was skipped."""
        if not pl_module.guard.in_a_row:
            super().on_train_batch_end(trainer, pl_module, *rest)


def _keep_best(trainer: L.Trainer, last: Path) -> None:
    """Let `last` be best.ckpt too where the validation after the training has the best score; its callback is over."""
    best = next(one for one in trainer.callbacks if isinstance(one, ModelCheckpoint) and one.monitor is not None)
    score = trainer.callback_metrics.get(best.monitor)
    if score is None or not trainer.max_epochs or not trainer.is_global_zero:
        return
    if score.isfinite() and (best.best_model_score is None or score > best.best_model_score.to(score.device)):
        keep_as(last, last.with_name(BEST))


def build_evaluation_trainer(precision: str, accelerator: str) -> L.Trainer:
    """A Trainer that only validates: one device, nothing written."""
    plugins = precision_plugins(precision)
    return L.Trainer(
        accelerator=accelerator,
        devices=1,
        precision=None if plugins else precision,
        plugins=plugins,
        logger=False,
        enable_checkpointing=False,
        enable_model_summary=False,
        use_distributed_sampler=False,
        callbacks=[LossProgressBar(refresh_rate=10)],
    )
