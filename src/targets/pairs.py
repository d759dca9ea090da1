"""Lists of (owner, item) pairs without a loop: the common step of every raster and painted target."""

from __future__ import annotations

import torch
from torch import Tensor


def enumerate_pairs(
    counts: Tensor,  # [n] int64, items of each owner
) -> tuple[Tensor, Tensor]:  # [sum], [sum] int64
    """For every item its owner and its position 0, 1, ... within that owner, ascending in both."""
    owners = torch.repeat_interleave(counts)
    starts = counts.cumsum(0) - counts
    return owners, torch.arange(len(owners), device=counts.device) - starts[owners]


def find_keys(
    keys: Tensor,  # [n] int64, sorted, unique
    wanted: Tensor,  # [q] int64
) -> Tensor:  # [q] int64
    """Row of each wanted key, -1 where it is absent."""
    if len(keys) == 0:
        return torch.full_like(wanted, -1)
    rows = torch.searchsorted(keys, wanted).clamp_(max=len(keys) - 1)
    return rows.where(keys[rows] == wanted, -1)
