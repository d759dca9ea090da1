"""Chosen rows of each sample."""

from __future__ import annotations

from torch import Tensor


def take_rows(
    value: Tensor,  # [B, n, ...]
    rows: Tensor,  # [B, K] int64
) -> Tensor:  # [B, K, ...]
    """value[b, rows[b, k]]."""
    index = rows.view(*rows.shape, *(1,) * (value.dim() - 2)).expand(*rows.shape, *value.shape[2:])
    return value.gather(1, index)
