"""`python -m src.train phase=phase1 ...`: one run, from configuration to metrics.json and pictures."""

from __future__ import annotations

import logging
import platform
import resource
import sys
import time
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
import yaml

from src.assembly import build_datamodule, build_module, data_root, save_submission
from src.command import run_command
from src.config import Config, compose_config, run_identity
from src.data.datamodule import DetectionDataModule
from src.errors import DataError
from src.metrics.report import format_scores
from src.ops.allocator import tune_cpu_allocator
from src.pictures.curves import draw_curves, draw_scores
from src.training.detection import DetectionModule
from src.training.fit import build_loggers, build_trainer, check_devices, fit
from src.training.run_folder import RunFolder, current_commit, write_json
from src.training.snapshots import draw_frames

logger = logging.getLogger(__name__)


def main(overrides: list[str]) -> None:
    """Train one run, or show it when it has finished already."""
    config, tree = compose_config(overrides)
    check_devices(config.trainer.accelerator.value, config.trainer.devices)
    folder = RunFolder(Path(config.paths.outputs), run_identity(tree))
    folder.open(config.resume)
    if folder.finished:
        show_finished(folder)
        return
    started = time.monotonic()
    tune_cpu_allocator()
    L.seed_everything(config.seed, verbose=False)
    log = logging.FileHandler(folder.log)
    log.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logging.getLogger().addHandler(log)
    folder.config.write_text(yaml.safe_dump(tree, sort_keys=False))
    logger.info("run %s in %s", folder.run_id, folder.path)

    root = data_root(config)
    datamodule = build_datamodule(config, root)
    module = build_module(config, tree, datamodule)
    resume_from = folder.newest_checkpoint()
    if resume_from is not None:
        logger.info("going on from %s", resume_from)
    trainer = make_trainer(config, tree, folder, resume_from)
    training_started = time.monotonic()
    fit(trainer, module, datamodule, resume_from)
    seconds = time.monotonic() - training_started

    scores = module.scores.as_dict()
    write_json(folder.metrics_json, scores)  # what took long is safe; run.json, the last file, marks the run finished
    draw_pictures(config, module, datamodule, folder, scores)
    save_submission(module, folder.path / "submission.json")
    record = {
        "run_id": folder.run_id,
        "overrides": overrides,
        "scale": config.scale,
        "seed": config.seed,
        "data": datamodule.identity(),
        "commit": current_commit(),
        "epochs": config.phase.epochs,
        "steps": trainer.global_step,
        "parameters": sum(p.numel() for p in module.model.parameters()),
        "resumed": resume_from is not None,
        "seconds": {"fit": round(seconds, 1), "all": round(time.monotonic() - started, 1)},
        "peak_memory_mib": peak_memory_mib(),
        "skipped_files": module.skipped,
        "device": str(module.device),
        "threads": torch.get_num_threads(),
        "versions": {
            "python": platform.python_version(),
            "torch": torch.__version__,
            "lightning": L.__version__,
            "numpy": np.__version__,
        },
    }
    write_json(folder.record, record)
    logger.info("finished in %.0f s", record["seconds"]["all"])
    print_result(folder, record, scores)


def draw_pictures(
    config: Config,
    module: DetectionModule,
    datamodule: DetectionDataModule,
    folder: RunFolder,
    scores: dict[str, Any],
) -> None:
    """Learning curves, bars by class and distance, and some validation frames spread over the split."""
    folder.pictures.mkdir(exist_ok=True)
    draw_curves(folder.pictures / "curves.png", folder.metrics_csv, folder.run_id)
    draw_scores(
        folder.pictures / "scores.png",
        {name: values["AP"] for name, values in scores["classes"].items()},
        {name: values["mAP"] for name, values in scores["ranges"].items()},
        folder.run_id,
    )
    frames = datamodule.validation_frames(config.trainer.num_pictures)
    draw_frames(module.model, [frame.to(module.device) for frame in frames], config.grid.build(), folder.pictures)


def make_trainer(config: Config, tree: dict[str, Any], folder: RunFolder, resume_from: Path | None) -> L.Trainer:
    """The Trainer of this configuration."""
    wandb = config.logger.wandb
    loggers = build_loggers(
        folder,
        resume_from,
        None if wandb is None else {"project": wandb.project, "offline": wandb.offline, "config": tree},
    )
    return build_trainer(
        folder,
        epochs=config.phase.epochs,
        validate_every=config.phase.validate_every,
        precision=config.precision,
        accelerator=config.trainer.accelerator.value,
        devices=config.trainer.devices,
        log_every_steps=config.trainer.log_every_steps,
        ema_decay=config.optim.ema_decay,
        loggers=loggers,
    )


def peak_memory_mib() -> dict[str, int]:
    """Largest resident memory of this process and of its largest ended child (a loader worker)."""
    unit = 1024 if sys.platform != "darwin" else 2**20  # Linux counts KiB, macOS bytes
    return {
        name: resource.getrusage(who).ru_maxrss // unit
        for name, who in (("process", resource.RUSAGE_SELF), ("largest_worker", resource.RUSAGE_CHILDREN))
    }


def show_finished(folder: RunFolder) -> None:
    """Print a finished run, and say when other code than today's made it. Raises DataError for edited results."""
    record, scores = folder.read_result()
    try:
        if record["commit"] != current_commit():
            logger.warning(
                "this run was made by commit %s, the code is at %s; resume=restart trains it anew",
                record["commit"],
                current_commit(),
            )
        print_result(folder, record, scores)
    except (KeyError, TypeError, ValueError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise DataError(
            f"{folder.record} or metrics.json beside it is not as written ({reason}); delete it to have it made again"
        ) from error


def print_result(folder: RunFolder, record: dict[str, Any], scores: dict[str, Any]) -> None:
    """The table people wait for, and where everything lies."""
    print(format_scores(scores))
    print(
        f"\n{folder.run_id}: {record['epochs']} epochs, {record['steps']} steps, {record['parameters'] / 1e6:.2f} M "
        f"parameters, {record['seconds']['all']:.0f} s, {record['peak_memory_mib']['process']} MiB"
    )
    if record["skipped_files"]:
        print(f"sensor files passed over: {record['skipped_files']}")
    print(f"run folder: {folder.path}  (metrics.json, metrics.csv, config.yaml, log.txt, pictures/, submission.json)")


if __name__ == "__main__":
    run_command(main)
