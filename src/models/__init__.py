"""Detectors. The one table of families: a model's name in the configuration, its settings, its class."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import Any

from pydantic import TypeAdapter, ValidationError

from src.errors import ConfigError
from src.geometry.bev_grid import BEVGrid
from src.models.backbones.image import ImageEncoderConfig
from src.models.centerpoint.model import CenterPoint, CenterPointConfig
from src.models.crt_fusion.model import CRTFusion, CRTFusionConfig
from src.models.dense_bev.model import DenseBEV, DenseBEVConfig
from src.models.detector import Detector, ModelConfig
from src.models.far3d.model import Far3D, Far3DConfig
from src.models.horizon3d.model import Horizon3D
from src.models.horizon3d.model_config import Horizon3DConfig
from src.models.hydra.model import HyDRa, HyDRaConfig
from src.models.lrs4fusion.lrs_config import LRS4FusionConfig
from src.models.lrs4fusion.model import LRS4Fusion
from src.models.petr.model import PETR, PETRConfig
from src.models.radargnn.model import RadarGNN, RadarGNNConfig
from src.models.rctrans.model import RCTrans, RCTransConfig
from src.models.sparc.model import SpaRC, SpaRCConfig

FAMILIES: dict[str, tuple[type[ModelConfig], type[Detector]]] = {
    "horizon3d": (Horizon3DConfig, Horizon3D),
    "dense_bev": (DenseBEVConfig, DenseBEV),
    "crt_fusion": (CRTFusionConfig, CRTFusion),
    "hydra": (HyDRaConfig, HyDRa),
    "sparc": (SpaRCConfig, SpaRC),
    "petr": (PETRConfig, PETR),
    "far3d": (Far3DConfig, Far3D),
    "rctrans": (RCTransConfig, RCTrans),
    "radargnn": (RadarGNNConfig, RadarGNN),
    "centerpoint": (CenterPointConfig, CenterPoint),
    "lrs4fusion": (LRS4FusionConfig, LRS4Fusion),
}


def build_model(
    config: ModelConfig,  # of one of FAMILIES
    grid: BEVGrid,
    backbone: ImageEncoderConfig | None,
    options: Mapping[str, Any],  # of the phase
) -> Detector:
    """The detector that a configuration asks for, with fresh weights. Raises ConfigError when its parts do not fit."""
    _, family = FAMILIES[config.name]
    return family(config, grid, backbone, read_phase_options(config.name, options))


def phase_option_names(name: str) -> set[str]:
    """Keys of `phase.options` that a family takes."""
    _, family = FAMILIES[name]
    return {field.name for field in dataclasses.fields(family.phase_options)}


def read_phase_options(name: str, options: Mapping[str, Any]) -> Any:
    """`phase.options` as a family's own dataclass. Raises ConfigError for others than it takes, and of another type."""
    _, family = FAMILIES[name]
    known = phase_option_names(name)
    if set(options) != known:
        raise ConfigError(
            f"phase.options has {', '.join(sorted(options)) or 'nothing'}, but model={name} takes "
            f"{', '.join(sorted(known)) or 'nothing'}"
        )
    try:
        return TypeAdapter(family.phase_options).validate_json(json.dumps(dict(options)), strict=True)
    except ValidationError as error:
        fault = error.errors()[0]
        raise ConfigError(f"phase.options.{fault['loc'][0]}={fault['input']!r}: {fault['msg']}") from None


def plain_phase_options(name: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """`phase.options` in the types of a family's own dataclass, so that 1 and 1.0 are one run. Raises as above."""
    kind = TypeAdapter(FAMILIES[name][1].phase_options)
    return kind.dump_python(read_phase_options(name, options), mode="json")
