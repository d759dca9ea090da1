"""Segment sums over rows of a table: deterministic, and without a tensor of one row per pair."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

# Pairs multiplied at a time in `row_products`; bounds its memory.
CHUNK = 16384


def bags(
    rows: Tensor,  # [pairs] integer
    num_rows: int,
) -> tuple[Tensor, Tensor]:
    """Stable order of the pairs by row [pairs], and the start of each row's bag [num_rows + 1], both int32."""
    ordered, order = torch.sort(rows, stable=True)
    starts = torch.searchsorted(ordered, torch.arange(num_rows + 1, dtype=rows.dtype, device=rows.device))
    return order.to(torch.int32), starts.to(torch.int32)


def bag_sum(
    values: Tensor,  # [n, C]
    picks: Tensor,  # [pairs] integer, rows of `values`, bag by bag
    starts: Tensor,  # [bags + 1], same type: first pair of each bag
    weights: Tensor | None = None,  # [pairs]
) -> Tensor:  # [bags, C]
    """(Weighted) sum of the picked rows of every bag; 0 for an empty bag."""
    if len(picks) == 0:
        return values.new_zeros(len(starts) - 1, values.shape[1])
    return F.embedding_bag(picks, values, starts, mode="sum", include_last_offset=True, per_sample_weights=weights)


def row_products(
    a: Tensor,  # [n, C]
    rows_a: Tensor,  # [pairs]
    b: Tensor,  # [m, C]
    rows_b: Tensor,  # [pairs]
) -> Tensor:  # [pairs]
    """Scalar products of paired rows, a chunk of pairs at a time."""
    out = a.new_empty(len(rows_a))
    for start in range(0, len(rows_a), CHUNK):
        span = slice(start, start + CHUNK)
        out[span] = (F.embedding(rows_a[span], a) * F.embedding(rows_b[span], b)).sum(1)
    return out
