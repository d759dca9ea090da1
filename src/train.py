"""`python -m src.train phase=phase1|phase2 ...`: one run, from configuration to metrics.json and pictures."""

from __future__ import annotations

import logging
import platform
import resource
import sys
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
import yaml
from lightning.pytorch.loggers.logger import Logger

from src.assembly import build_datamodule, build_module, data_root, save_submission
from src.config import PHASES, Config, compose_config
from src.data.datamodule import DetectionDataModule
from src.errors import DataError
from src.pictures.learning_curves import draw_curves
from src.reliability.allocator import tune_cpu_allocator
from src.reliability.checkpoints import OpenCheckpoint, open_checkpoint
from src.reliability.command import run_command
from src.reliability.processes import (
    build_strategy,
    check_devices,
    created_externally,
    decided_by_main,
    end_processes,
    gather_by_rank,
    is_main_process,
    launch,
    process_group,
)
from src.structures.skipped import SHOWN_NAMES, SkippedFiles
from src.training.fit import build_loggers, build_trainer, fit
from src.training.handoff import WeightSource, find_source, hand_over, open_source, train_source
from src.training.identity import run_identity
from src.training.module import TrainingModule
from src.training.phases import EVALUATORS
from src.training.run_folder import Resume, RunFolder, current_commit, write_json
from src.training.snapshots import draw_frames
from src.training.wandb import WandbRun

logger = logging.getLogger(__name__)


def main(overrides: list[str]) -> None:
    """Train one run, or show it when it has finished; start its processes first when there are to be several."""
    started = time.monotonic()
    config, tree = compose_config(overrides)
    where = (config.trainer.accelerator.value, config.trainer.devices, config.trainer.num_nodes)
    check_devices(*where)
    source = find_source(config, overrides, compose_config, PHASES)
    folder = RunFolder(Path(config.paths.outputs), run_identity(tree, source.identity if source is not None else None))
    if config.trainer.num_processes > 1 and not created_externally():
        if source is not None and not source.ready and begins(folder, config.resume):
            train_source(source, config.phase.train_missing, processes_exist=False)
        launch("src.train", overrides, config.trainer.devices)
        return
    with process_group(*where):
        start = prepare(config, tree, folder, source)
        if start is not None:
            run(config, tree, folder, source, start, started, overrides)


def begins(folder: RunFolder, resume: Resume) -> bool:
    """Whether the run starts from its source's weights: asked to restart, or with no checkpoint of its own."""
    if resume is Resume.never and folder.path.exists():
        return False  # it will be refused
    return resume is Resume.restart or not (folder.finished or folder.has_checkpoint)


@dataclass
class StartingPoint:
    """What a run starts from; each process has opened its checkpoint once, and no other before the first step."""

    root: Path  # of the data
    resume: OpenCheckpoint | None = None  # the run's own newest checkpoint
    weights: OpenCheckpoint | None = None  # its source's, where there is none of its own


def prepare(
    config: Config, tree: dict[str, Any], folder: RunFolder, source: WeightSource | None
) -> StartingPoint | None:
    """Decide in the main process what all start from, and open it in each; None for a finished run, which is shown.

    The source's weights are opened before the own folder is touched: where that fails, everything is as it was.
    """
    resume = weights = None

    def decide() -> dict[str, Any] | None:
        nonlocal resume, weights
        if source is not None and begins(folder, config.resume):
            if not source.ready:
                train_source(source, config.phase.train_missing, processes_exist=config.trainer.num_processes > 1)
            weights = open_source(source)
        folder.open(config.resume)
        if folder.finished:
            show_finished(config, folder)
            return None
        resume = folder.newest_checkpoint()
        start_log(config, tree, folder)
        return {"resume": resume and str(resume.path), "root": str(data_root(config))}

    decided = decided_by_main(decide)
    if decided is None:
        return None
    if decided["resume"] is not None:
        return StartingPoint(Path(decided["root"]), resume=resume or open_checkpoint(Path(decided["resume"])))
    return StartingPoint(Path(decided["root"]), weights=weights or (source and open_source(source)))


def start_log(config: Config, tree: dict[str, Any], folder: RunFolder) -> None:
    """Write log.txt from here on, and config.yaml."""
    log = logging.FileHandler(folder.log)
    log.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logging.getLogger().addHandler(log)
    folder.config.write_text(yaml.safe_dump(tree, sort_keys=False))
    logger.info("run %s in %s", folder.run_id, folder.path)


def run(
    config: Config,
    tree: dict[str, Any],
    folder: RunFolder,
    source: WeightSource | None,
    start: StartingPoint,
    started: float,  # time.monotonic()
    overrides: list[str],
) -> None:
    """Train on every process; the main one then leaves results and pictures."""
    tune_cpu_allocator()
    L.seed_everything(config.seed, verbose=False)
    datamodule = build_datamodule(config, start.root)
    module = build_module(config, tree, datamodule)
    if start.resume is not None:
        logger.info("resuming from %s", start.resume.path)
    elif start.weights is not None:
        hand_over(module.model, start.weights, tree)
    loggers = build_loggers(folder, start.resume, config.logger.wandb, tree) if is_main_process() else []
    trainer = make_trainer(config, folder, loggers)
    training_started = time.monotonic()
    fit(trainer, module, datamodule, start.resume)
    seconds = time.monotonic() - training_started
    skipped = SkippedFiles()
    skipped.restore(gather_by_rank(module.skipped.state()))
    end_processes()
    if not is_main_process():
        return

    module.to(trainer.strategy.root_device)  # Lightning leaves it on the CPU
    scores = module.evaluator.as_dict()
    write_json(folder.metrics_json, scores)  # what took long is safe; run.json, the last file, marks the run finished
    draw_pictures(config, module, datamodule, folder)
    module.evaluator.write(folder.path, partial(save_submission, config))
    record = {
        "run_id": folder.run_id,
        "task": config.phase.task,
        "headline": module.evaluator.headline,
        "overrides": overrides,
        "scale": config.scale,
        "seed": config.seed,
        "data": datamodule.identity(),
        "commit": current_commit(),
        "initialized_from": source.identity if source is not None else None,
        "epochs": config.phase.epochs,
        "steps": trainer.global_step,
        "parameters": sum(p.numel() for p in module.model.parameters()),
        "resumed": start.resume is not None,
        "seconds": {"fit": round(seconds, 1), "all": round(time.monotonic() - started, 1)},
        "peak_memory_mib": peak_memory_mib(),
        "skipped_files": dict(skipped.channels),
        "skipped_names": skipped.names(),
        "skipped_steps": module.guard.skipped_steps,
        "device": str(module.device),
        "processes": config.trainer.num_processes,
        "threads": torch.get_num_threads(),
        "versions": {
            "python": platform.python_version(),
            "torch": torch.__version__,
            "lightning": L.__version__,
            "numpy": np.__version__,
        },
    }
    folder.finish(record)
    if skipped:
        logger.warning("skipped sensor files: %s", skipped.text())
    logger.info("finished in %.0f s", record["seconds"]["all"])
    print_result(config, folder, record, scores)
    for tracked in [own for own in loggers if isinstance(own, WandbRun)]:
        print(f"W&B: {tracked.finish(scores, folder.pictures) or 'not complete, see the warning above'}")


def draw_pictures(config: Config, module: TrainingModule, datamodule: DetectionDataModule, folder: RunFolder) -> None:
    """Learning curves, the evaluator's pictures, and some validation frames spread over the split."""
    folder.pictures.mkdir(exist_ok=True)
    draw_curves(folder.pictures / "curves.png", folder.metrics_csv, folder.run_id)
    module.evaluator.draw(folder.pictures, folder.run_id)
    length = config.model.memory_frames + 1 if config.phase.temporal else 1
    clips = datamodule.validation_clips(config.trainer.num_pictures, length)
    draw_frames(module.model, clips, config.grid.build(), folder.pictures)


def make_trainer(config: Config, folder: RunFolder, loggers: list[Logger]) -> L.Trainer:
    """The Trainer of this configuration; the main process alone has loggers."""
    where = (config.trainer.accelerator.value, config.trainer.devices, config.trainer.num_nodes)
    return build_trainer(
        folder,
        epochs=config.phase.epochs,
        validate_every=config.phase.validate_every,
        monitor=config.phase.monitor,
        precision=config.precision,
        accelerator=config.trainer.accelerator.value,
        devices=config.trainer.devices,
        num_nodes=config.trainer.num_nodes,
        strategy=build_strategy(*where),
        checkpoint_every_steps=config.trainer.checkpoint_every_steps,
        log_every_steps=config.trainer.log_every_steps,
        ema_decay=config.optim.ema_decay,
        loggers=loggers,
        deterministic=config.trainer.deterministic,
    )


def peak_memory_mib() -> dict[str, int]:
    """Largest resident memory of this process and of its largest ended child (a loader worker)."""
    unit = 1024 if sys.platform != "darwin" else 2**20  # Linux counts KiB, macOS bytes
    return {
        name: resource.getrusage(who).ru_maxrss // unit
        for name, who in (("process", resource.RUSAGE_SELF), ("largest_worker", resource.RUSAGE_CHILDREN))
    }


def show_finished(config: Config, folder: RunFolder) -> None:
    """Print a finished run, and say when other code than today's made it. Raises DataError for edited results."""
    record, scores = folder.read_result()
    try:
        if record["commit"] != current_commit():
            logger.warning(
                "this run was made by commit %s, the code is at %s; resume=restart trains it anew",
                record["commit"],
                current_commit(),
            )
        print_result(config, folder, record, scores)
    except (KeyError, TypeError, ValueError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise DataError(
            f"{folder.record} or metrics.json beside it is not as written ({reason}); delete it to have it made again"
        ) from error


def print_result(config: Config, folder: RunFolder, record: dict[str, Any], scores: dict[str, Any]) -> None:
    """The table people wait for, and where everything lies."""
    print(EVALUATORS[config.phase.task].describe(scores))
    print(
        f"\n{folder.run_id}: {record['epochs']} epochs, {record['steps']} steps, {record['parameters'] / 1e6:.2f} M "
        f"parameters, {record['seconds']['all']:.0f} s, {record['peak_memory_mib']['process']} MiB"
    )
    if record["skipped_files"]:
        names = record.get("skipped_names", [])  # older records have none
        shown = f": {', '.join(names[:SHOWN_NAMES])}{' ...' if len(names) > SHOWN_NAMES else ''}" if names else ""
        print(f"skipped sensor files: {record['skipped_files']}{shown} (names in run.json)")
    print(f"run folder: {folder.path}  (metrics.json, metrics.csv, config.yaml, log.txt, pictures/, submission.json)")


if __name__ == "__main__":
    run_command(main)
