"""Lists of unequal length laid end to end: the items of every owner, and the cells of every window."""

from __future__ import annotations

import torch
from torch import Tensor


def enumerate_items(
    counts: Tensor,  # [n] int64, items of each owner
) -> tuple[Tensor, Tensor]:  # [sum], [sum] int64
    """For every item its owner and its position 0, 1, ... within that owner, ascending in both."""
    owners = torch.repeat_interleave(counts)
    starts = counts.cumsum(0) - counts
    return owners, torch.arange(len(owners), device=counts.device) - starts.index_select(0, owners)


def enumerate_windows(
    low: Tensor,  # [n, 2] int64 (col, row) of the first cell
    high: Tensor,  # [n, 2] int64 (col, row) of the last cell; below `low` in a window without cells
) -> tuple[Tensor, Tensor, Tensor]:  # [pairs] int64 each
    """(window, row, col) of every cell of every window, ordered by window and row-major within."""
    widths, heights = (high - low + 1).clamp(min=0).unbind(1)
    window, place = enumerate_items(widths * heights)
    width = widths.index_select(0, window)
    down = torch.div(place, width, rounding_mode="floor")
    corner = low.index_select(0, window)
    return window, corner[:, 1] + down, corner[:, 0] + place - down * width
