"""Embedding of the age of a remembered observation (method 6.1 to 6.3)."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class TimeEmbedding(nn.Module):
    """MLP 1-C-C of an age in seconds. Runs in float32 so that 2 Hz frames stay apart under autocast."""

    full_precision_parts = ("",)

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(nn.Linear(1, channels), nn.ReLU(), nn.Linear(channels, channels))

    def forward(
        self,
        elapsed_s: Tensor,  # [...]
    ) -> Tensor:  # [..., C]
        """Embedding of each age."""
        with torch.autocast(elapsed_s.device.type, enabled=False):
            return self.mlp(elapsed_s.float()[..., None])
