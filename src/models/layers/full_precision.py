"""Last layers of heads: their outputs are ranked, or read as metres and metres per second."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from src.losses.normalizers import full_precision


class FullPrecisionLinear(nn.Linear):
    """A linear layer in float32 whatever autocast says: in bfloat16 scores tie and 30 m/s has steps of 0.1."""

    full_precision_parts = ("",)

    def forward(self, x: Tensor) -> Tensor:
        with torch.autocast(x.device.type, enabled=False):
            return super().forward(full_precision(x))


class FullPrecisionConv2d(nn.Conv2d):
    """A convolution in float32 whatever autocast says, see `FullPrecisionLinear`."""

    full_precision_parts = ("",)

    def forward(self, x: Tensor) -> Tensor:
        with torch.autocast(x.device.type, enabled=False):
            return super().forward(full_precision(x))
