"""Normalisers of the losses, averaged over ranks (method 8.1)."""

from __future__ import annotations

import torch
import torch.distributed as dist
from torch import Tensor


@torch.no_grad()
def mean_over_ranks(
    count: Tensor,  # any shape, on the device of the process
) -> Tensor:
    """Mean of a count over all ranks, with their total clamped to at least 1.

    Gradients are averaged over ranks, so N ranks divide exactly as one process with the batch of all of them, even with
    a single object in total; a rank without objects neither explodes nor weighs more. Every rank must call it.
    """
    count = count.to(torch.float32, copy=True)
    if not (dist.is_available() and dist.is_initialized()):
        return count.clamp_(min=1.0)
    dist.all_reduce(count)
    return count.clamp_(min=1.0) / dist.get_world_size()


@torch.no_grad()
def any_over_ranks(
    flag: Tensor,  # [] bool, on the device of the process
) -> Tensor:  # [] bool
    """Whether it holds on any rank. Every rank must call it."""
    value = flag.to(torch.float32)
    if dist.is_available() and dist.is_initialized():
        dist.all_reduce(value, dist.ReduceOp.MAX)
    return value > 0


def full_precision(x: Tensor) -> Tensor:
    """The tensor in float32, or as it is in float64: loss arithmetic never runs in half precision."""
    return x if x.dtype == torch.float64 else x.float()
