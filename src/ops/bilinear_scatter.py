"""Rows moved onto a map: each is shared among the four cells around its place, the transpose of bilinear sampling."""

from __future__ import annotations

import torch
from torch import Tensor

from src.ops.segment_reduce import weighted_segment_sum


def bilinear_scatter(
    values: Tensor,  # [n, C]
    places: Tensor,  # [n, 2] (x, y) in cells from the map's lower corner; cell (row, col) has its centre at + 0.5
    sample: Tensor,  # [n] int64
    shape: tuple[int, int, int],  # (B, rows, cols)
) -> Tensor:  # [B * rows * cols, C]
    """Bilinear weights times values, summed by cell and divided by their weights where these exceed 1.

    So a row on a centre comes through exactly, and rows that meet are averaged. What lies outside is dropped.
    Differentiable in the values.
    """
    batch_size, rows, cols = shape
    corner = (places - 0.5).floor()
    share = places - 0.5 - corner  # [n, 2] of the upper neighbour
    keys, weights = [], []
    for right, up in ((0, 0), (1, 0), (0, 1), (1, 1)):
        x, y = (corner + corner.new_tensor([right, up])).unbind(1)
        part = (share[:, 0] if right else 1 - share[:, 0]) * (share[:, 1] if up else 1 - share[:, 1])
        inside = (x >= 0) & (x < cols) & (y >= 0) & (y < rows) & (part > 0)
        key = (sample * rows + torch.where(inside, y, 0).long()) * cols + torch.where(inside, x, 0).long()
        keys.append(torch.where(inside, key, -1))
        weights.append(part)
    key, order = torch.cat(keys).sort(stable=True)
    first = int((key < 0).sum())
    key, order = key[first:], order[first:]
    weight = torch.cat(weights)[order].to(values.dtype)
    totals = weight.new_zeros(batch_size * rows * cols).index_add(0, key, weight)
    picks = order % max(len(values), 1)
    return weighted_segment_sum(values, weight / totals.clamp(min=1.0)[key], picks, key, len(totals))
