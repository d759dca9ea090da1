"""Focal losses and the depth loss, unreduced or summed, for the caller to divide by its normaliser (method 8.1)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from src.losses.normalizers import full_precision

PEAK_CLAMP = 1e-4
DEPTH_CLAMP = 1e-6
FOCAL_ALPHA = 0.25


def penalty_reduced_focal(
    logits: Tensor,  # [...]
    target: Tensor,  # [...] heat map in 0..1, exactly 1 at peaks
) -> Tensor:  # [...]
    """CornerNet's focal loss per element, exponents 2 and 4 (method 4.3 and 7).

    Peaks cost -(1 - S)^2 log S, all others -(1 - y)^4 S^2 log(1 - S). S is kept in [1e-4, 1 - 1e-4]; where that binds
    the gradient is 0.
    """
    score = full_precision(logits).sigmoid().clamp(PEAK_CLAMP, 1 - PEAK_CLAMP)
    peak = -((1 - score) ** 2) * score.log()
    rest = -((1 - target) ** 4) * score**2 * (1 - score).log()
    return torch.where(target == 1, peak, rest)


def sigmoid_focal(
    logits: Tensor,  # [...]
    target: Tensor,  # [...] bool
) -> Tensor:  # [...]
    """Focal loss per element with alpha 0.25 and gamma 2, stable for any logit."""
    logits = full_precision(logits)
    score = logits.sigmoid()
    positive = -FOCAL_ALPHA * (1 - score) ** 2 * F.logsigmoid(logits)
    negative = -(1 - FOCAL_ALPHA) * score**2 * F.logsigmoid(-logits)
    return torch.where(target, positive, negative)


def depth_cross_entropy(
    logits: Tensor,  # [V, D, h, w] before the softmax over D
    target: Tensor,  # [V, h, w] int64 bin, -1 for background
) -> Tensor:  # []
    """Binary cross-entropy between softmax and one-hot, summed over bins and foreground cells (method 4.3)."""
    foreground = (target >= 0).flatten().nonzero().squeeze(1)
    logits = logits.movedim(1, -1).flatten(0, -2).index_select(0, foreground)  # [n, D]
    score = full_precision(logits).softmax(-1).clamp(DEPTH_CLAMP, 1 - DEPTH_CLAMP)
    bins = torch.arange(logits.shape[1], device=logits.device)
    wanted = target.flatten().index_select(0, foreground)[:, None] == bins
    return -torch.where(wanted, score, 1 - score).log().sum()
