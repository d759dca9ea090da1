"""Batch norms that do not count their batches."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn


class MapNorm(nn.BatchNorm2d):
    """Batch norm over maps, as torch's but for its counter; see `normalize`."""

    def forward(
        self,
        x: Tensor,  # [M, C, H, W]
    ) -> Tensor:  # [M, C, H, W]
        return normalize(self, x)


def normalize(
    norm: nn.BatchNorm1d | nn.BatchNorm2d,
    x: Tensor,  # [M, C, ...]
) -> Tensor:
    """What the norm's own forward gives, with `num_batches_tracked` left as it was loaded.

    Only a norm without a fixed momentum reads it, and a GPU would launch an addition for each norm in every step.
    """
    statistics = (norm.running_mean, norm.running_var)
    return F.batch_norm(x, *statistics, norm.weight, norm.bias, norm.training, norm.momentum, norm.eps)
