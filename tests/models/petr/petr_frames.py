"""A PETR of a few thousand parameters for the frames of the dense baseline's tests."""

import torch

from src.config import compose_config
from src.models import build_model
from tests.models.dense_bev.dense_frames import GRID, backbone

SMALL = (
    "scale=debug", "model=petr", "data.root=x", "model.channels=32", "model.position.depth_range_m=[1,40]",
    "model.num_queries=32", "model.decoder.num_heads=4",
)  # fmt: skip


def petr_model(*overrides, phase="phase1", seed=0):
    """Fresh weights with the random state fixed."""
    torch.manual_seed(seed)
    config, _ = compose_config([*SMALL, f"phase={phase}", *overrides])
    return build_model(config.model, GRID, backbone(), config.phase.options)
