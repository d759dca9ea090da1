"""Sets of Gaussians for tests."""

import torch

from src.structures.gaussians import GaussianSet


def gaussians_at(means, **columns) -> GaussianSet:
    """Round Gaussians at means [B, G, 2] that stand, of the radar, all of them valid; `columns` say otherwise."""
    b, g, _ = means.shape
    plain = {
        "scales": torch.ones(b, g, 2),
        "directions": torch.tensor([1.0, 0.0]).expand(b, g, 2),
        "opacity_logits": torch.zeros(b, g),
        "velocities": torch.zeros(b, g, 2),
        "features": torch.ones(b, g, 1),
        "sources": torch.zeros(b, g, dtype=torch.int64),
        "elapsed_s": torch.zeros(b, g),
        "valid": torch.ones(b, g, dtype=torch.bool),
    }
    return GaussianSet(means=means, **(plain | columns))
