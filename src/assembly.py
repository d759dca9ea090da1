"""From a configuration to its pieces: data, model, module. Shared by the entry points."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from src.config import Config
from src.data.datamodule import DetectionDataModule
from src.data.timeline import RadialSpeeds
from src.errors import ConfigError, DataError
from src.metrics.submission import write_submission
from src.models import build_model as build_model_of
from src.models.backbones.weights import BackboneName
from src.models.detector import Detector
from src.reliability.checkpoints import load_model_weights
from src.structures.detections import DetectionTable
from src.structures.taxonomy import SENSORS
from src.training.handoff import norms_handed_over
from src.training.module import TrainingModule
from src.training.phases import EVALUATORS, MODULES
from src.training.trainer_config import OnNonfinite
from src.world.world_config import world_digest
from src.world.write import ensure_world

logger = logging.getLogger(__name__)

MAX_WORKERS_PER_CORE = 4


def data_root(config: Config, write: bool = True) -> Path:
    """Folder to read, written first when it is a synthetic world that does not exist yet.

    With `write` false a given root is read as it is, whatever made it, and never written (evaluation on other data: a
    mistyped folder must not become a synthetic world that is then scored).
    Raises ConfigError when there is neither a root nor a world to write; DataError when the folder holds another world.
    """
    data = config.data
    if data.root is not None and (not write or data.world is None):
        return Path(data.root)  # the reader says what is missing
    if data.world is None:
        raise ConfigError("data.root is null and there is no data.world to write; give data.root=FOLDER")
    root = Path(data.root) if data.root else Path(config.paths.outputs) / "worlds" / world_digest(data.world)
    return ensure_world(data.world, root)


def samples_of(config: Config) -> dict[str, Any]:
    """What `data.root` holds, as runs record it; nothing where it is away or an empty mount point."""
    root = config.data.root
    if root is None or not any(Path(root).glob("*")):
        return {}  # without a root the world identifies the run
    return build_datamodule(config, data_root(config)).state_dict()


def check_data(
    config: Config, run: Path, recorded: dict[str, Any], find: Callable[[Config], dict[str, Any]] = samples_of
) -> None:
    """Raises DataError when `find` finds other samples than the run has recorded; older runs recorded none."""
    samples = recorded.get("samples_digest")
    found = {} if samples is None else find(config)
    if found and samples != found["samples_digest"]:
        raise DataError(
            f"{run} was trained on {recorded.get('data')} with the samples {samples}, but data.root="
            f"{config.data.root} holds {found['data']} with the samples {found['samples_digest']}; give the data.root "
            "of the run, another paths.outputs, or train it with resume=restart, which moves it aside, anew on these"
        )


def build_datamodule(config: Config, root: Path) -> DetectionDataModule:
    """The data of a run, of the sensors that its model uses."""
    cores = os.cpu_count() or 1
    if config.data.num_workers > MAX_WORKERS_PER_CORE * cores:
        raise ConfigError(
            f"data.num_workers={config.data.num_workers}: at most {MAX_WORKERS_PER_CORE} for each of the {cores} cores "
            "of this machine, more would only take memory"
        )
    return DetectionDataModule(
        config.data,
        root=root,
        sensors=config.model.sensors,
        image_size_px=config.image_size_px,
        seed=config.draw_seed,
        cache=Path(config.paths.outputs) / "cache",
        temporal=config.phase.temporal,
        name="synthetic highway" if config.data.world is not None else None,
        labels=EVALUATORS[config.phase.task].labels,
        read_by=f"model={config.model.name}",
    )


def build_model(config: Config, pretrained: bool = True) -> Detector:
    """The configured detector with fresh weights (and pretrained backbone weights where given).

    With `pretrained` false their file, which may not be on this machine, is not read: a checkpoint brings all weights.
    Warns of a V2-99 from scratch, whose batch norm would keep to the statistics that pretrained weights bring.
    """
    if pretrained and config.backbone.name is BackboneName.vovnet99 and config.backbone.weights is None:
        logger.warning(
            "backbone=vovnet99 without backbone.weights: its batch norm never learns statistics (method 3), so from "
            "scratch it normalises nothing; give backbone.weights=FILE (FCOS3D's or DD3D's)"
        )
    backbone = config.backbone if pretrained else replace(config.backbone, weights=None)
    return build_model_of(config.model, config.grid.build(), backbone, config.phase.options)


def restored_model(config: Config, checkpoint: dict[str, Any], path: Path) -> Detector:
    """The configured detector with the weights of a checkpoint that has been read from `path`."""
    model = build_model(config, pretrained=False)
    load_model_weights(model, checkpoint, path)
    return model


def save_submission(config: Config, path: Path, tokens: list[str], table: DetectionTable) -> bool:
    """Write boxes of these samples as a submission; False, with a warning and no file, when there is none."""
    if not len(table):
        path.unlink(missing_ok=True)  # of an earlier command, whose boxes these are not
        logger.warning("no box reached the score threshold, so there is no valid submission to write")
        return False
    max_age_s, window_s = config.model.memory_max_age_s, config.data.past_window_s
    memory = "no memory"  # the benchmark's rules are about how far back a detector looks
    if max_age_s is not None and window_s is None:
        memory = f"memory of frames of up to {max_age_s:g} s, in which older inputs may live on"
    elif max_age_s is not None:
        memory = f"memory of inputs of up to {window_s:g} s"
    meta: dict[str, bool | str] = {f"use_{sensor}": sensor in config.model.sensors for sensor in SENSORS}
    timeline = config.data.timeline
    if timeline is not None and timeline.radial_speeds is RadialSpeeds.radar:
        # The speeds of LiDAR returns are an input, and come from radar sweeps up to RADAR_WINDOW_S after them too.
        meta |= {"use_radar": True, "use_future_frames": True}
    meta |= {
        "method_name": config.model.name,
        "description": f"scale {config.scale}, seed {config.seed}, {memory}",
    }
    write_submission(path, tokens, table, meta)
    return True


def build_module(
    config: Config,
    tree: dict[str, Any],
    datamodule: DetectionDataModule | None,  # of the evaluation; None for a module that does not evaluate
    model: Detector | None = None,  # None: as `build_model`
) -> TrainingModule:
    """The LightningModule of a run; `tree` is the configuration as plain values."""
    model = build_model(config) if model is None else model
    return MODULES[config.phase.module](
        model,
        optim=config.optim,
        backbone_lr_multiplier=config.backbone.lr_multiplier,
        evaluator=config.phase.evaluator(datamodule) if datamodule is not None else None,
        seed=config.draw_seed,
        config=tree,
        skip_nonfinite=config.trainer.on_nonfinite is OnNonfinite.skip,
        frozen_norms=norms_handed_over(model) if config.phase.frozen_statistics else (),
    )
