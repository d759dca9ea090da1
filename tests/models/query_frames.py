"""Query detectors of a few thousand parameters for the frames of the dense baseline's tests."""

import torch

from src.config import compose_config
from src.models import build_model
from tests.models.frames import GRID, backbone

FAMILIES = {
    "far3d": ("model.queries.depth_range_m=[1,40]", "model.num_queries=32"),
    "petr": ("model.position.depth_range_m=[1,40]", "model.num_queries=32"),
    "rctrans": ("model.position.depth_range_m=[1,40]", "model.num_queries=32", "model.pillar_cells=2"),
    "sparc": ("model.radar_encoder.channels=32", "model.queries.depth_range_m=[1,40]", "model.queries.num_radar=40"),
}


def settings(family, *overrides, phase="phase1"):
    """The composed configuration of a small one."""
    common = ("scale=debug", f"model={family}", "data.root=x", "model.channels=32", "model.decoder.num_heads=4")
    return compose_config([*common, *FAMILIES[family], f"phase={phase}", *overrides])[0]


def small_model(family, *overrides, phase="phase1", seed=0):
    """Fresh weights with the random state fixed."""
    torch.manual_seed(seed)
    config = settings(family, *overrides, phase=phase)
    return build_model(config.model, GRID, backbone(), config.phase.options)
