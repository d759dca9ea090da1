"""Absolute errors with unknown targets; unreduced, for the caller to weigh and divide (method 8.1)."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from src.losses.normalizers import full_precision


def masked_l1(
    prediction: Tensor,  # [...]
    target: Tensor,  # [...], NaN where unknown
) -> Tensor:  # [...]
    """|prediction - target|; 0 without gradient where the target is NaN."""
    prediction = full_precision(prediction)
    return (prediction - target.where(~target.isnan(), prediction.detach())).abs()


def masked_smooth_l1(
    prediction: Tensor,  # [...]
    target: Tensor,  # [...], NaN where unknown
    beta: float = 1.0,
) -> Tensor:  # [...]
    """Smooth L1, which is e^2 / (2 beta) below beta; 0 without gradient where the target is NaN."""
    prediction = full_precision(prediction)
    known = target.where(~target.isnan(), prediction.detach()).to(prediction.dtype)
    return F.smooth_l1_loss(prediction, known, reduction="none", beta=beta)
