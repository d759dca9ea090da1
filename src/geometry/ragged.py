"""Lists of unequal length laid end to end: the items of every owner, and the cells of every window."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from src.geometry.constants import arange


def enumerate_items(
    counts: Tensor,  # [n] int64, items of each owner
) -> tuple[Tensor, Tensor]:  # [sum], [sum] int64
    """For every item its owner and its position 0, 1, ... within that owner, ascending in both."""
    owners = torch.repeat_interleave(counts)
    starts = counts.cumsum(0) - counts
    return owners, arange(len(owners), torch.int64, counts.device) - starts.index_select(0, owners)


def enumerate_some(
    counts: Tensor,  # [n] int64, items of each owner
    size: int,
) -> tuple[Tensor, Tensor, Tensor]:  # [size], [size], [1] int64
    """The first `size` items as `enumerate_items` lists them, owner n behind the last, and how many there are."""
    ends = counts.cumsum(0)
    item = arange(size, torch.int64, counts.device)
    owners = torch.searchsorted(ends, item, right=True)
    starts = F.pad(ends - counts, (0, 1))
    return owners, item - starts.index_select(0, owners), ends[-1:]


def enumerate_windows(
    low: Tensor,  # [n, 2] int64 (col, row) of the first cell
    high: Tensor,  # [n, 2] int64 (col, row) of the last cell; below `low` in a window without cells
) -> tuple[Tensor, Tensor, Tensor]:  # [pairs] int64 each
    """(window, row, col) of every cell of every window, ordered by window and row-major within."""
    widths, heights = (high - low + 1).clamp(min=0).unbind(1)
    window, place = enumerate_items(widths * heights)
    return window, *_cells(low, widths, window, place)


def enumerate_some_windows(
    low: Tensor,  # [n, 2] int64 (col, row)
    high: Tensor,  # [n, 2] int64 (col, row)
    size: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # [size] int64 each, [1] int64
    """The first `size` cells as `enumerate_windows` lists them, and how many there are; the window of none is n."""
    widths, heights = (high - low + 1).clamp(min=0).unbind(1)
    window, place, total = enumerate_some(widths * heights, size)
    return window, *_cells(low, widths.clamp(min=1), window.clamp(max=len(low) - 1), place), total


def _cells(low: Tensor, widths: Tensor, window: Tensor, place: Tensor) -> tuple[Tensor, Tensor]:
    """Row and column of places in windows; of no meaning in one without cells."""
    width = widths.index_select(0, window)
    down = torch.div(place, width, rounding_mode="floor")
    corner = low.index_select(0, window)
    return corner[:, 1] + down, corner[:, 0] + place - down * width
