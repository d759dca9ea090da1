"""Nearest neighbours within the samples of a packed batch, by comparing all with all."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from src.ops.segment_reduce import segment_count

MAX_PAIRS = 8_000_000
"""Distances that are looked at together, which bounds the memory."""


def nearest_neighbours(
    xy: Tensor,  # [n, 2] m, finite
    sample: Tensor,  # [n] int64, ascending
    batch_size: int,
    count: int,
) -> tuple[Tensor, Tensor]:  # [n, count] int64, [n, count] bool
    """The other points of the same sample nearest to each in x and y, nearest first, and which of them exist.

    Where a sample has fewer, a point's own row stands. Synchronises with a GPU once.
    """
    own = torch.arange(len(xy), device=xy.device)
    counts = segment_count(sample, batch_size)
    starts = counts.cumsum(0) - counts
    longest = int(counts.max()) if len(xy) else 1
    padded = xy.new_full((batch_size, longest, 2), torch.inf)
    padded[sample, own - starts[sample]] = xy
    kept = min(count, longest)
    squared, places = xy.new_zeros(len(xy), kept), sample.new_zeros(len(xy), kept)
    step = max(1, MAX_PAIRS // longest)
    for first in range(0, len(xy), step):
        rows = own[first : first + step]
        axes = zip(padded.unbind(2), xy[rows].unbind(1), strict=True)
        apart = sum((all_of[sample[rows]] - one[:, None]).square_() for all_of, one in axes)  # [rows, longest]
        apart.scatter_(1, (rows - starts[sample[rows]])[:, None], torch.inf)
        squared[rows], places[rows] = apart.topk(kept, dim=1, largest=False)
    present = F.pad(squared.isfinite(), (0, count - kept))
    return torch.where(present, F.pad(places, (0, count - kept)) + starts[sample][:, None], own[:, None]), present
