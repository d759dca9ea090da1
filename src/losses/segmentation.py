"""Occupancy losses: focal on a splatted map evaluated sparsely, Dice and Lovasz-Softmax (method 5.6, 8.1)."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from src.losses.classification import FOCAL_ALPHA
from src.losses.normalizers import full_precision
from src.ops.segment_reduce import segment_count
from src.ops.splat import log1mexp

MIN_OCCUPANCY = 1e-4


def occupancy_losses(
    log_free: Tensor,  # [n] S = log(1 - alpha) <= 0 on the support
    support: Tensor,  # [n] int64 linear keys, unique
    occupied: Tensor,  # [P] int64 linear keys of the positive cells, sorted, unique
    batch_size: int,
    cells_per_sample: int,
) -> tuple[Tensor, Tensor]:  # [], []
    """Focal loss summed over the whole grid, and Dice loss averaged over samples, of the occupancy alpha (method 5.6).

    Only the support and the positive cells are evaluated: elsewhere alpha = 0 and the target 0, a loss of 0. The
    focal form is alpha 0.25, gamma 2. A positive cell costs no more than at alpha = 1e-4, without gradient there.
    """
    log_free = full_precision(log_free)
    target = torch.isin(support, occupied, assume_unique=True)
    occupancy = -torch.expm1(log_free)
    reached = log_free.clamp(max=math.log1p(-MIN_OCCUPANCY))
    positive = -FOCAL_ALPHA * torch.exp(2 * reached) * log1mexp(-reached)
    negative = -(1 - FOCAL_ALPHA) * occupancy**2 * log_free
    missed = (len(occupied) - target.sum()).to(log_free.dtype)
    cost_of_miss = -FOCAL_ALPHA * (1 - MIN_OCCUPANCY) ** 2 * math.log(MIN_OCCUPANCY)
    focal = torch.where(target, positive, negative).sum() + missed * cost_of_miss

    sample = torch.div(support, cells_per_sample, rounding_mode="floor")
    positives = segment_count(torch.div(occupied, cells_per_sample, rounding_mode="floor"), batch_size)
    return focal, dice(occupancy, target, sample, batch_size, positives)


def dice(
    score: Tensor,  # [M] in 0..1
    target: Tensor,  # [M] bool
    sample: Tensor,  # [M] int64
    batch_size: int,
    num_positives: Tensor | None = None,  # [B], where positives exist outside the given cells
) -> Tensor:  # []
    """1 - (2 sum score target + 1) / (sum score + sum target + 1) per sample, averaged over samples."""
    score, weight = full_precision(score), target.to(full_precision(score).dtype)
    sums = score.new_zeros(batch_size, 3)
    sums = sums.index_add(0, sample, torch.stack([score * weight, score, weight], dim=1))
    overlap, total, positives = sums.unbind(1)
    positives = positives if num_positives is None else num_positives
    return (1 - (2 * overlap + 1) / (total + positives + 1)).mean()


def lovasz_foreground(
    score: Tensor,  # [M] in 0..1
    target: Tensor,  # [M] bool
    sample: Tensor,  # [M] int64, ascending
    batch_size: int,
) -> Tensor:  # []
    """Lovasz-Softmax of the foreground class per sample, averaged over samples; 0 for a sample without foreground."""
    foreground = target.to(full_precision(score).dtype)
    # Per sample, the inner product of the sorted errors with the gradient of the Jaccard loss at their order.
    errors, order = (foreground - full_precision(score)).abs().sort(descending=True, stable=True)
    owner, by_sample = sample[order].sort(stable=True)
    errors, target = errors[by_sample], target[order[by_sample]]
    starts = torch.searchsorted(owner, torch.arange(batch_size + 1, device=owner.device))
    place = torch.arange(len(owner), device=owner.device) - starts[owner]
    before = F.pad(target.to(errors.dtype).cumsum(0), (1, 0))  # counts, exact up to 2^24
    found = before[1:] - before[starts[owner]]  # foreground up to here
    total = (before[starts[1:]] - before[starts[:-1]])[owner]
    jaccard = 1 - (total - found) / (total + place + 1 - found)
    steps = torch.where(place == 0, jaccard, jaccard - jaccard.roll(1))
    terms = torch.where(total > 0, errors * steps, 0.0)
    return errors.new_zeros(batch_size).index_add(0, owner, terms).mean()
