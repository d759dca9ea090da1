"""Farthest point sampling: a subset of points that covers the set (method 6.2)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from src.ops.backend import implementation


@torch.no_grad()
def farthest_points(
    points: Tensor,  # [B, G, 2] m, finite where valid
    valid: Tensor,  # [B, G] bool
    start: Tensor,  # [B] int64, first pick of each sample; of no meaning where a sample has no valid point
    count: int,
) -> Tensor:  # [B, count] int64 rows in order of picking, -1 where a sample has fewer valid points
    """Each pick is the valid point farthest from all earlier ones, ties by lowest row.

    Raises ValueError when shapes disagree.
    """
    b, g = valid.shape
    if points.shape != (b, g, 2) or start.shape != (b,):
        raise ValueError(
            f"points {list(points.shape)}, valid {list(valid.shape)} and start {list(start.shape)} must be [B, G, 2], "
            "[B, G] and [B]"
        )
    return implementation(farthest_points_reference)(points, valid, start, count)


def farthest_points_reference(points: Tensor, valid: Tensor, start: Tensor, count: int) -> Tensor:
    """One iteration per pick: in numpy on a CPU, a tenth of torch's time, else in torch."""
    if points.device.type != "cpu":
        return pick_on_device(points, valid, start, count)
    picks = [_pick(*sample, count) for sample in zip(points.numpy(), valid.numpy(), start.tolist(), strict=True)]
    return torch.from_numpy(np.array(picks, dtype=np.int64).reshape(len(picks), count))


def pick_on_device(points: Tensor, valid: Tensor, start: Tensor, count: int) -> Tensor:
    """All samples at once, without synchronising with a GPU."""
    b, g = valid.shape
    picks = start.new_full((b, count), -1)
    if g == 0:
        return picks
    gap = torch.where(valid, torch.inf, -1.0)  # squared distance to the nearest pick; -1: not to be picked (again)
    samples = torch.arange(b, device=points.device)
    pick = start.clone()
    for step in range(min(count, g)):
        picks[:, step] = torch.where(gap[samples, pick] >= 0, pick, -1)
        squared = (points - points[samples, pick, None]).square().sum(-1)
        gap = torch.where(gap >= 0, torch.minimum(gap, squared), gap)
        gap[samples, pick] = -1.0
        pick = gap.argmax(dim=1)
    return picks


def _pick(points: np.ndarray, valid: np.ndarray, pick: int, count: int) -> np.ndarray:
    """The picks [count] of one sample of points [G, 2]."""
    picks = np.full(count, -1)
    x, y = np.where(valid, points[:, 0], 0), np.where(valid, points[:, 1], 0)
    gap = np.where(valid, np.inf, -1).astype(points.dtype)  # as above; the least of -1 and a distance is -1
    across, along = np.empty_like(x), np.empty_like(y)
    for step in range(min(count, len(points))):
        if gap[pick] < 0:
            break
        picks[step] = pick
        np.subtract(x, x[pick], out=across)
        np.subtract(y, y[pick], out=along)
        across *= across
        along *= along
        across += along
        np.minimum(gap, across, out=gap)
        gap[pick] = -1
        pick = int(gap.argmax())
    return picks
