"""What a phase file may name: the module that trains it (`phase.module`), the evaluator of its task (`phase.task`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from src.data.datamodule import DetectionDataModule
from src.errors import ConfigError, require_least
from src.metrics.protocol import Protocol
from src.training.evaluator import DetectionEvaluator, Evaluator
from src.training.module import TrainingModule
from src.training.temporal_module import TemporalModule
from src.training.world_evaluators import ForecastEvaluator, OccupancyEvaluator

MODULES: dict[str, type[TrainingModule]] = {kind.__name__: kind for kind in (TrainingModule, TemporalModule)}
EVALUATORS: dict[str, type[Evaluator]] = {
    "detection": DetectionEvaluator,
    "occupancy": OccupancyEvaluator,
    "forecasting": ForecastEvaluator,
}


@dataclass(kw_only=True)
class PhaseConfig:
    """One training phase."""

    name: str
    module: str  # what trains it, one of MODULES
    task: str  # what a validation scores, one of EVALUATORS
    monitor: str  # logged number that best.ckpt is chosen by, larger being better
    temporal: bool  # clips in order with memory; false: shuffled single frames, and the model has no temporal part
    init_from: str | None  # a phase, that is the run of the same command in it; a run id; or a checkpoint's path
    train_missing: bool  # train the run that init_from names when it has not finished yet
    frozen_statistics: bool  # norms that came with the weights of `init_from` use their running statistics in training
    epochs: int  # 0: the weights of `init_from` as they are, scored with this run's settings
    validate_every: int  # epochs
    long_range: Protocol | None  # a second score of detections, beside the official one
    options: dict[str, Any]  # what the phase says to the model's family

    def __post_init__(self) -> None:
        for key, known in (("module", MODULES), ("task", EVALUATORS)):
            if getattr(self, key) not in known:
                raise ConfigError(f"phase.{key}={getattr(self, key)}: must be one of {', '.join(known)}")
        if MODULES[self.module].temporal is not self.temporal:
            raise ConfigError(
                f"phase.temporal={self.temporal} does not go with phase.module={self.module}, which is for "
                f"{'streamed clips' if MODULES[self.module].temporal else 'single frames'}"
            )
        known = [f"val/{name}" for name in EVALUATORS[self.task].monitored]
        if self.monitor not in known:
            raise ConfigError(f"phase.monitor={self.monitor}: must be one of {', '.join(known)}, larger being better")
        if self.long_range is not None and self.task != "detection":
            raise ConfigError(
                f"phase.long_range scores detections, but phase.task={self.task}; give phase.long_range=null"
            )
        require_least(self, "phase", {"epochs": 0, "validate_every": 1})
        if self.epochs == 0 and self.init_from is None:
            raise ConfigError("phase.epochs=0 scores the weights of phase.init_from, which is null; name a run or file")

    def evaluator(self, datamodule: DetectionDataModule) -> Evaluator:
        """What scores a validation of these data."""
        kind = EVALUATORS[self.task]
        return kind.of(datamodule) if self.long_range is None else kind.of(datamodule, self.long_range)
