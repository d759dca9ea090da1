"""Focal losses and the depth loss, unreduced or summed, for the caller to divide by its normaliser (method 8.1)."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import FunctionCtx, once_differentiable

from src.losses.normalizers import full_precision, mean_over_ranks

PEAK_CLAMP = 1e-4
DEPTH_CLAMP = 1e-6
FOCAL_ALPHA = 0.25
EXACT_SOFTPLUS = 50.0
"""log(1 + e^x) is x from here on, in float64 too."""


def penalty_reduced_focal(
    logits: Tensor,  # [...]
    target: Tensor,  # [...] heat map in 0..1, exactly 1 at peaks
) -> Tensor:  # [...]
    """CornerNet's focal loss per element, exponents 2 and 4 (method 4.3 and 7).

    Peaks cost -(1 - S)^2 log S, all others -(1 - y)^4 S^2 log(1 - S). S is kept in [1e-4, 1 - 1e-4]; where that binds
    the gradient is 0.
    """
    logits = full_precision(logits)
    peak = (target == 1).to(logits.dtype)
    return _Focal.apply(logits, torch.rsub(peak, 1, alpha=2), (1 - target) ** 4 + peak, PEAK_CLAMP)


def sigmoid_focal(
    logits: Tensor,  # [...]
    target: Tensor,  # [...] bool
) -> Tensor:  # [...]
    """Focal loss per element with alpha 0.25 and gamma 2, stable for any logit."""
    logits = full_precision(logits)
    positive = target.to(logits.dtype)
    scale = torch.rsub(positive, 1 - FOCAL_ALPHA, alpha=1 - 2 * FOCAL_ALPHA)
    return _Focal.apply(logits, torch.rsub(positive, 1, alpha=2), scale, None)


def balanced_focal(
    logits: Tensor,  # [M]
    occupied: Tensor,  # [K] int64, rows that are, each once
) -> Tensor:  # []
    """Focal loss, the mean over what is occupied and the mean over all others added (CRT-Fusion's public code)."""
    target = torch.zeros_like(logits, dtype=torch.bool)
    target[occupied] = True
    focal = sigmoid_focal(logits, target)
    inside, total = focal[occupied].sum(), focal.sum()
    count = occupied.new_tensor(len(occupied))
    return inside / mean_over_ranks(count) + (total - inside) / mean_over_ranks(len(focal) - count)


class _Focal(torch.autograd.Function):
    """-scale q^2 log(1 - q), q the probability of what is wrong, kept in [clamp, 1 - clamp] if that is given.

    The gradient scale q^2 (q - 2 (1 - q) log(1 - q)) is made on the way: a third of the launches, nothing else kept.
    """

    @staticmethod
    def forward(
        ctx: FunctionCtx,
        logits: Tensor,  # [...]
        sign: Tensor,  # [...] -1 where the score should be 1, else 1
        scale: Tensor,  # [...]
        clamp: float | None,
    ) -> Tensor:  # [...]
        wrong = logits * sign
        q, surprise = wrong.sigmoid(), F.softplus(wrong, threshold=EXACT_SOFTPLUS)
        if clamp is not None:
            free, q = q, q.clamp(clamp, 1 - clamp)
            surprise = surprise.clamp_(-math.log1p(-clamp), -math.log(clamp))
            sign = sign * (free == q)
        weight = q * q * scale
        ctx.save_for_backward(torch.addcmul(q, 1 - q, surprise, value=2).mul_(weight).mul_(sign))
        return weight * surprise

    @staticmethod
    @once_differentiable
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor, None, None, None]:
        (slope,) = ctx.saved_tensors
        return grad * slope, None, None, None


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
