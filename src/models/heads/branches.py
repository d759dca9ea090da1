"""Branches of a centre head: two layers per output, on every cell or on chosen ones."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.geometry.constants import constant
from src.losses.normalizers import full_precision
from src.models.layers.full_precision import FullPrecisionLinear
from src.models.layers.merging import LinearReLU, block_diagonal, joined_linear
from src.models.layers.sparse import RowBatchNorm
from src.ops.checkpointed_mlp import checkpointed_mlp, projected_statistics

CPU_CHUNK = 512
"""Rows at a time through a wide hidden layer, so that it stays in the cache."""


class Branches(nn.Module):
    """Parallel branches of one input, each linear, batch norm, ReLU, linear; one matrix makes all hidden layers."""

    norm_pairs = (("hidden", "norm"),)
    checkpointed = True
    """Evaluate by `checkpointed_branches` instead of layer by layer."""

    def __init__(self, channels: int, widths: tuple[int, ...]) -> None:
        super().__init__()
        self.hidden = nn.Linear(channels, len(widths) * channels, bias=False)
        self.norm = RowBatchNorm(len(widths) * channels)
        self.outputs = nn.ModuleList(FullPrecisionLinear(channels, width) for width in widths)

    def forward(
        self,
        x: Tensor,  # [n, C]
    ) -> Tensor:  # [n, sum of widths] float32
        """Outputs of all branches side by side."""
        if self.checkpointed:
            return checkpointed_branches([self], x)
        hidden = F.relu(self.norm(self.hidden(x)), inplace=True).chunk(len(self.outputs), dim=1)  # [n, C] each
        return torch.cat([output(h) for output, h in zip(self.outputs, hidden, strict=True)], dim=1)


def checkpointed_branches(
    parts: Sequence[Branches],
    x: Tensor,  # [n, C]
) -> Tensor:  # [n, sum of all widths] float32
    """Outputs of several sets of branches side by side, as one network of two layers whose hidden layer is not kept.

    A batch norm after a linear layer is a linear layer once its statistics are known, and those follow from mean and
    covariance of the input: no hidden layer is ever stored, normalised or read again. Layer by layer, a training step
    on 50,000 cells keeps some 2 GiB of them (seven groups of six branches, C = 128).
    """
    with torch.autocast(x.device.type, enabled=False):
        weight = torch.cat([part.hidden.weight for part in parts])  # [H, C]
        mean, variance = _norm_statistics(parts, x, weight)
        scale = torch.cat([part.norm.weight for part in parts]) * (variance + parts[0].norm.eps).rsqrt()
        shift = torch.cat([part.norm.bias for part in parts]) - mean * scale
        outputs = [output for part in parts for output in part.outputs]
        rows, out_bias = torch.cat([o.weight for o in outputs]), torch.cat([o.bias for o in outputs])
        owner = [number for number, out in enumerate(outputs) for _ in range(len(out.weight))]
        own = tuple(tuple(number == row for number in range(len(outputs))) for row in owner)
        blocks = constant(own, rows.dtype, rows.device)  # [O, branches], 1 where an output belongs to a branch
        out_weight = (rows[:, None] * blocks[:, :, None]).flatten(1)  # [O, H], block diagonal
    return checkpointed_mlp(x, (weight * scale[:, None]).t(), shift, out_weight.t(), out_bias)


def _norm_statistics(
    parts: Sequence[Branches],
    x: Tensor,  # [n, C]
    weight: Tensor,  # [H, C]
) -> tuple[Tensor, Tensor]:  # [H], [H]
    """Mean and variance that the norms divide by: the batch's in training, where the running ones learn from them."""
    if not parts[0].norm.training or len(x) < 2:
        return torch.cat([p.norm.running_mean for p in parts]), torch.cat([p.norm.running_var for p in parts])
    mean, variance = projected_statistics(full_precision(x), weight)
    with torch.no_grad():
        widths = [len(part.norm.running_mean) for part in parts]
        unbiased = variance * (len(x) / (len(x) - 1))
        for part, its_mean, its_variance in zip(parts, mean.split(widths), unbiased.split(widths), strict=True):
            part.norm.running_mean.lerp_(its_mean, part.norm.momentum)
            part.norm.running_var.lerp_(its_variance, part.norm.momentum)
    return mean, variance


class MergedBranches(nn.Module):
    """All branches of several `Branches` on the same input: one product to all hidden layers, one from them."""

    def __init__(self, branches: Sequence[Branches]) -> None:
        super().__init__()
        hidden = [part.hidden for part in branches]
        outputs = [output for part in branches for output in part.outputs]
        weight, bias = (torch.cat([getattr(x, name) for x in hidden]) for name in ("weight", "bias"))
        self.hidden = joined_linear(weight, bias, LinearReLU)
        self.outputs = block_diagonal(outputs)

    def forward(
        self,
        x: Tensor,  # [n, C]
    ) -> Tensor:  # [n, sum of widths] float32
        """Outputs of all branches side by side."""
        parts = [x] if x.device.type != "cpu" else x.split(CPU_CHUNK)
        found = [self.outputs(self.hidden(part)) for part in parts]
        return found[0] if len(found) == 1 else torch.cat(found)
