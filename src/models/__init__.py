"""Detectors. The one table: a model's name in the configuration, its settings, its class."""

from __future__ import annotations

from src.geometry.bev_grid import BEVGrid
from src.models.backbones.image import ImageEncoderConfig
from src.models.dense_bev.model import DenseBEV, DenseBEVConfig
from src.models.detector import Detector, ModelConfig
from src.models.horizon3d.model import Horizon3D, Horizon3DConfig

MODEL_CONFIGS: dict[str, type[ModelConfig]] = {"horizon3d": Horizon3DConfig, "dense_bev": DenseBEVConfig}
MODELS: dict[type[ModelConfig], type[Detector]] = {Horizon3DConfig: Horizon3D, DenseBEVConfig: DenseBEV}


def build_model(
    config: ModelConfig,  # an instance of one of MODEL_CONFIGS
    grid: BEVGrid,
    backbone: ImageEncoderConfig | None,
    velocity_code_weight: float,
) -> Detector:
    """The detector that a configuration asks for, with fresh weights. Raises ConfigError when its parts do not fit."""
    return MODELS[type(config)](config, grid, backbone, velocity_code_weight)
