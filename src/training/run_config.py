"""What the training knows of a run's configuration."""

from __future__ import annotations

from typing import Protocol

from src.models.detector import ModelConfig
from src.training.phases import PhaseConfig
from src.training.run_folder import PathsConfig
from src.training.trainer_config import TrainerConfig


class RunConfig(Protocol):
    """The fields of `src.config.Config` that are read here."""

    model: ModelConfig
    phase: PhaseConfig
    trainer: TrainerConfig
    paths: PathsConfig
    precision: str
    scale: str
    seed: int
