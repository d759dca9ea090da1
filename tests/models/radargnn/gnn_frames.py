"""A RadarGNN of a few thousand parameters for the frames of the dense baseline's tests."""

import torch

from src.config import compose_config
from src.models import build_model
from tests.models.frames import GRID

SMALL = ("scale=debug", "model=radargnn", "data.root=x", "phase=phase1")


def gnn_model(*overrides):
    """Fresh weights with the random state fixed; no backbone."""
    torch.manual_seed(0)
    config, _ = compose_config([*SMALL, *overrides])
    return build_model(config.model, GRID, None, config.phase.options)
