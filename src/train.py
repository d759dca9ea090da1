"""`python -m src.train phase=phase1|phase2 ...`: one run, from configuration to metrics.json and pictures."""

from __future__ import annotations

import logging
import time
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import lightning as L

from src.assembly import build_datamodule, build_model, build_module, check_data, data_root, save_submission
from src.config import PHASES, Config, compose_config, refuse_options_of_others
from src.data.datamodule import DetectionDataModule
from src.pictures.learning_curves import draw_curves
from src.reliability.checkpoints import LAST, OpenCheckpoint, open_checkpoint, stated_digest
from src.reliability.command import run_command
from src.reliability.cpu import tune_cpu
from src.reliability.processes import (
    check_devices,
    created_externally,
    decided_by_main,
    end_processes,
    gather_by_rank,
    is_main_process,
    launch,
    process_group,
)
from src.report.run_curves import curves_of
from src.structures.skipped import SkippedFiles
from src.training.fit import build_loggers, build_trainer, fit
from src.training.handoff import WeightSource, find_source, hand_over, open_source, train_source
from src.training.identity import run_identity
from src.training.module import TrainingModule
from src.training.result import print_result, run_record, show_finished
from src.training.run_folder import Resume, RunFolder, write_json
from src.training.wandb import WandbRun

logger = logging.getLogger(__name__)


def main(overrides: list[str]) -> None:
    """Train one run, or show it when it has finished; start its processes first when there are to be several."""
    started = time.monotonic()
    config, tree = compose_config(overrides)
    refuse_options_of_others(config, "train")
    check_devices(*config.trainer.processes)
    source = find_source(config, overrides, compose_config, PHASES)
    folder = RunFolder(Path(config.paths.outputs), run_identity(tree, source.identity if source is not None else None))
    if config.trainer.num_processes > 1 and not created_externally():
        if source is not None and not source.ready and begins(folder, config.resume):
            train_source(source, config.phase.train_missing, processes_exist=False)
        launch("src.train", overrides, config.trainer.devices)
        return
    with process_group(*config.trainer.processes), closing(folder):
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
            check_data(config, folder.path, folder.read_result()[0])
            show_finished(folder)
            return None
        resume = folder.newest_checkpoint()
        if resume is not None:
            check_data(config, folder.path, resume.content.get(DetectionDataModule.__qualname__, {}))
        folder.start_log(tree)
        return {"resume": resume and str(resume.path), "root": str(data_root(config))}

    decided = decided_by_main(decide)
    if decided is None:
        return None
    if decided["resume"] is not None:
        return StartingPoint(Path(decided["root"]), resume=resume or open_checkpoint(Path(decided["resume"])))
    return StartingPoint(Path(decided["root"]), weights=weights or (source and open_source(source)))


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
    tune_cpu()
    L.seed_everything(config.seed, verbose=False)
    datamodule = build_datamodule(config, start.root)
    data = datamodule.state_dict()  # the folder may be away when the first checkpoint is written
    model = build_model(config, pretrained=start.resume is None and start.weights is None)
    module = build_module(config, tree, datamodule, model)
    if start.resume is not None:
        logger.info("resuming from %s", start.resume.path)
    elif start.weights is not None:
        hand_over(module.model, start.weights, tree)
        module.initial_weights = stated_digest(start.weights.path)
    loggers = build_loggers(folder, start.resume, config.logger.wandb, tree) if is_main_process() else []
    trainer = build_trainer(
        folder,
        config.trainer,
        config.phase,
        precision=config.precision,
        ema_decay=config.optim.ema_decay,
        loggers=loggers,
    )
    training_started = time.monotonic()
    fit(trainer, module, datamodule, start.resume)
    seconds = time.monotonic() - training_started
    skipped = SkippedFiles()
    skipped.restore(gather_by_rank(module.skipped.state()))
    end_processes()
    if not is_main_process():
        return

    module.to(trainer.strategy.root_device)  # Lightning leaves it on the CPU
    scores = leave_scores(config, folder, module, datamodule)
    record = run_record(
        config,
        module,
        run_id=folder.run_id,
        overrides=overrides,
        **data,
        initialized_from=source.identity if source is not None else None,
        initial_weights=module.initial_weights,
        weights=stated_digest(folder.checkpoints / LAST),
        resumed=start.resume is not None,
        seconds=durations(seconds, time.monotonic() - started, module.earlier_s),
        skipped_files=dict(skipped.channels),
        skipped_names=skipped.names(),
    )
    folder.finish(record)
    if skipped:
        logger.warning("skipped sensor files: %s", skipped.text())
    logger.info("finished in %.0f s", time.monotonic() - started)
    print_result(folder, record, scores)
    for tracked in [own for own in loggers if isinstance(own, WandbRun)]:
        print(f"W&B: {tracked.finish(scores, folder.pictures) or 'not complete, see the warning above'}")


def durations(fit_s: float, all_s: float, earlier_s: float | None) -> dict[str, float]:
    """Durations for run.json: `fit` and `all` include `earlier`, the time before a resumption, where that is known."""
    if earlier_s is None:
        return {"fit": round(fit_s, 1), "all": round(all_s, 1)}
    return {"fit": round(earlier_s + fit_s, 1), "all": round(earlier_s + all_s, 1), "earlier": round(earlier_s, 1)}


def leave_scores(
    config: Config, folder: RunFolder, module: TrainingModule, datamodule: DetectionDataModule
) -> dict[str, Any]:
    """Write all but run.json, the last file, which marks a run finished: scores first, since they took long."""
    scores = module.evaluator.as_dict()
    write_json(folder.metrics_json, scores)
    draw_pictures(config, module, datamodule, folder)
    module.evaluator.write(folder.path, partial(save_submission, config))
    return scores


def draw_pictures(config: Config, module: TrainingModule, datamodule: DetectionDataModule, folder: RunFolder) -> None:
    """Learning curves, and the evaluator's pictures of the scores and of some validation frames."""
    folder.pictures.mkdir(exist_ok=True)
    draw_curves(folder.pictures / "curves.png", curves_of(folder.metrics_csv), folder.run_id)
    module.evaluator.draw(folder.pictures, folder.run_id)
    length = config.model.memory_frames + 1 if config.phase.temporal else 1
    clips = datamodule.validation_clips(config.trainer.num_pictures, length)
    module.evaluator.draw_frames(module.model, clips, config.grid.build(), folder.pictures)


if __name__ == "__main__":
    run_command(main)
