"""Dense detectors of radar and cameras of a few thousand parameters, for the frames of the dense baseline's tests."""

from functools import partial

import torch

from src.config import compose_config
from src.models import build_model
from tests.models.frames import GRID, backbone


def settings(family):
    return (
        "scale=debug", f"model={family}", "data.root=x", "model.channels=16", "model.view_transform.hidden_channels=16",
        "model.view_transform.context_channels=12", "model.view_transform.image_stride_px=16",
        "model.view_transform.depth_range_m=[1,40]", "model.decoder.stage_channels=[16,16,24]",
        "model.decoder.stage_strides=[2,2,1]", "model.decoder.blocks_per_stage=2",
    )  # fmt: skip


def small_model(family, *overrides, phase="phase1", seed=0):
    """Fresh weights with the random state fixed."""
    torch.manual_seed(seed)
    config, _ = compose_config([*settings(family), f"phase={phase}", *overrides])
    return build_model(config.model, GRID, backbone(), config.phase.options)


crt_model, hydra_model = (partial(small_model, family) for family in ("crt_fusion", "hydra"))


def radar_map(cells):
    """[2, 4, rows, cols] with random features at (sample, row, col)."""
    torch.manual_seed(1)
    bev = torch.zeros(2, 4, *GRID.cells)
    for sample, row, col in cells:
        bev[sample, :, row, col] = torch.rand(4) + 0.1
    return bev
