"""Batch norms that do not count their batches; layer norms with what stands around them."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

from src.ops.add_layer_norm import add_layer_norm


class MapBatchNorm(nn.BatchNorm2d):
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


def layer_norm(
    norm: nn.LayerNorm,
    x: Tensor,  # [..., C]
    added: Tensor | None = None,  # [..., C]
    relu: bool = False,
) -> Tensor:  # [..., C]
    """What the norm gives of x, or of its sum with `added`, and a ReLU if asked for: without gradient one launch."""
    return add_layer_norm(x, (norm.weight, norm.bias), norm.eps, added, relu)[0]
