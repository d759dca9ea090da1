"""AdamW on the right parameters and the cyclic schedule (Table 10, method 10)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import nn
from torch.nn.modules.conv import _ConvNd
from torch.optim.lr_scheduler import LRScheduler

from src.errors import ConfigError, require_least
from src.models.layers.sparse import SparseKernel


@dataclass(kw_only=True)
class OptimConfig:
    """Optimiser and learning-rate cycle."""

    lr: float  # start of the cycle
    weight_decay: float  # on weights of convolutions and linear layers only
    clip_norm: float  # global L2 norm of the gradient
    peak_lr_ratio: float  # peak of the cycle over lr
    final_lr_ratio: float  # end of the cycle over lr
    rise_fraction: float  # share of the steps that climb
    betas: list[float]  # AdamW's [beta1, beta2]
    cycled_beta1: list[float] | None  # beta1 at the ends and at the peak; null = constant betas
    ema_decay: float | None  # moving average of the weights; null = off

    def __post_init__(self) -> None:
        for name in ("lr", "clip_norm", "peak_lr_ratio"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"optim.{name} must be above 0, but got {getattr(self, name)}")
        require_least(self, "optim", {"weight_decay": 0, "final_lr_ratio": 0})
        if not 0 <= self.rise_fraction <= 1:
            raise ConfigError(f"optim.rise_fraction must lie in [0, 1], but got {self.rise_fraction}")
        for name in ("betas", "cycled_beta1"):
            value = getattr(self, name)
            if value is not None and (len(value) != 2 or not all(0 <= beta < 1 for beta in value)):
                raise ConfigError(f"optim.{name} must be two numbers in [0, 1), but got {value}")
        if self.cycled_beta1 is not None and self.betas[0] != self.cycled_beta1[0]:
            raise ConfigError(
                f"optim.betas={self.betas} begins with another beta1 than optim.cycled_beta1={self.cycled_beta1}, "
                "which sets it at every step; give both the same, or cycled_beta1=null for a constant one"
            )
        if self.ema_decay is not None and not 0 < self.ema_decay < 1:
            raise ConfigError(f"optim.ema_decay must be null or lie in (0, 1), but got {self.ema_decay}")


def parameter_groups(
    model: nn.Module, config: OptimConfig, backbone: nn.Module | None, backbone_lr_multiplier: float
) -> list[dict[str, object]]:
    """Split the parameters by weight decay (convolution and linear weights only) and by backbone learning rate.

    Norms, biases, embeddings and learnable slots are not decayed. Empty groups are left out.
    """
    decayed = {
        id(module.weight) for module in model.modules() if isinstance(module, (nn.Linear, _ConvNd, SparseKernel))
    }
    in_backbone = {id(parameter) for parameter in backbone.parameters()} if backbone is not None else set()
    groups: dict[tuple[bool, bool], list[nn.Parameter]] = {}
    for parameter in model.parameters():
        if parameter.requires_grad:
            groups.setdefault((id(parameter) in in_backbone, id(parameter) in decayed), []).append(parameter)
    return [
        {
            "params": parameters,
            "lr": config.lr * (backbone_lr_multiplier if is_backbone else 1.0),
            "weight_decay": config.weight_decay if is_decayed else 0.0,
        }
        for (is_backbone, is_decayed), parameters in groups.items()
    ]


def cycle_value(step: int, total_steps: int, rise_fraction: float, start: float, peak: float, end: float) -> float:
    """Cosine from `start` to `peak` over the rising share of the steps, then cosine from `peak` to `end`."""
    rise = rise_fraction * total_steps
    if step < rise:
        done, low, high = step / rise, start, peak
    else:
        done, low, high = min(1.0, (step - rise) / max(1.0, total_steps - rise)), peak, end
    return high + (low - high) * 0.5 * (1 + math.cos(math.pi * done))


class CyclicSchedule(LRScheduler):
    """Learning rate up by `peak_lr_ratio`, then down to `final_lr_ratio`; beta1 the other way round."""

    def __init__(self, optimizer: torch.optim.Optimizer, config: OptimConfig, total_steps: int) -> None:
        self.config = config
        self.total_steps = total_steps
        super().__init__(optimizer)

    def state_dict(self) -> dict[str, object]:
        """Only plain numbers, so that a checkpoint loads without executing code."""
        return {"last_epoch": self.last_epoch, "base_lrs": self.base_lrs, "total_steps": self.total_steps}

    def get_lr(self) -> list[float]:
        """Learning rate of every group at the current step; sets beta1 on the way."""
        config = self.config
        ratio = cycle_value(
            self.last_epoch, self.total_steps, config.rise_fraction, 1.0, config.peak_lr_ratio, config.final_lr_ratio
        )
        if config.cycled_beta1 is not None:
            high, low = config.cycled_beta1
            beta1 = cycle_value(self.last_epoch, self.total_steps, config.rise_fraction, high, low, high)
            for group in self.optimizer.param_groups:
                group["betas"] = (beta1, group["betas"][1])
        return [base * ratio for base in self.base_lrs]


def build_optimizer(
    model: nn.Module,
    config: OptimConfig,
    total_steps: int,
    backbone: nn.Module | None,
    backbone_lr_multiplier: float,
) -> tuple[torch.optim.AdamW, CyclicSchedule]:
    """AdamW and its schedule over `total_steps` optimiser steps."""
    groups = parameter_groups(model, config, backbone, backbone_lr_multiplier)
    optimizer = torch.optim.AdamW(groups, lr=config.lr, betas=tuple(config.betas), fused=True)
    return optimizer, CyclicSchedule(optimizer, config, total_steps)
