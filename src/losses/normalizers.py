"""What losses are divided by (spec section 8.1)."""

from __future__ import annotations

import torch
import torch.distributed as dist
from torch import Tensor


@torch.no_grad()
def mean_over_ranks(
    count: Tensor | int,  # any shape
) -> Tensor:
    """Mean of a count over all ranks, at least 1: a rank without objects neither explodes nor weighs more."""
    count = torch.as_tensor(count).to(torch.float32, copy=True)
    if dist.is_available() and dist.is_initialized():
        dist.all_reduce(count)
        count /= dist.get_world_size()
    return count.clamp_(min=1.0)


def full_precision(x: Tensor) -> Tensor:
    """The tensor in float32, or as it is in float64: loss arithmetic never runs in half precision."""
    return x if x.dtype == torch.float64 else x.float()
