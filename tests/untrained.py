"""Checkpoints of untrained models at debug scale, made in a second."""

from dataclasses import replace

import torch

from src.assembly import build_model
from src.config import compose_config


def write_checkpoint(path, *overrides):
    """An untrained debug model, made lively enough that boxes and memory depend on what it sees."""
    config, tree = compose_config(["scale=debug", *overrides])
    torch.manual_seed(1)
    model = build_model(replace(config, backbone=replace(config.backbone, weights=None)))
    with torch.no_grad():
        for name, value in model.named_parameters():
            if "temporal" in name or name.startswith("dptf."):  # zero-initialised, and silent, otherwise
                value.add_(0.3 * torch.randn_like(value))
            if "occupancy" in name and name.endswith("bias"):
                value.zero_()  # trained ones remember what they think is occupied, fresh ones nothing
    content = {"state_dict": {f"model.{key}": value for key, value in model.state_dict().items()}}
    torch.save(content | {"horizon3d": {"config": tree}}, path)
    return path
