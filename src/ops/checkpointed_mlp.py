"""A two-layer perceptron on many rows, checkpointed: the hidden layer is recomputed in the backward pass."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd.function import FunctionCtx

CPU_ROWS = 1024
GPU_ROWS = 1 << 18
"""Rows of a chunk: on a CPU its hidden layer stays in the cache, on a GPU it bounds the memory."""


def checkpointed_mlp(
    x: Tensor,  # [n, C]
    hidden_weight: Tensor,  # [C, H]
    hidden_bias: Tensor,  # [H]
    weight: Tensor,  # [H, O]
    bias: Tensor,  # [O]
) -> Tensor:  # [n, O]
    """relu(x W + b) V + c in chunks of rows, differentiable in all operands.

    Recomputing the hidden layer costs one product, keeping it [n, H] of memory, written and read several times.
    Under autocast the operands are cast to its type by hand; gradients of weights are summed in float32 at least.
    """
    operands = (x, hidden_weight, hidden_bias, weight, bias)
    if torch.is_autocast_enabled(x.device.type) and x.dtype != torch.float64:
        operands = tuple(value.to(torch.get_autocast_dtype(x.device.type)) for value in operands)
    return _CheckpointedMLP.apply(*operands)


def projected_statistics(
    x: Tensor,  # [n, C], n > 0
    weight: Tensor,  # [H, C]
) -> tuple[Tensor, Tensor]:  # [H], [H]
    """Mean and variance (divided by n) of the columns of x W^T, from mean and covariance of x alone."""
    centre = x.mean(0)
    x = x - centre
    covariance = x.t() @ x / len(x)  # [C, C]
    return weight @ centre, (weight @ covariance * weight).sum(1).clamp(min=0)


class _CheckpointedMLP(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: FunctionCtx, x: Tensor, hidden_weight: Tensor, hidden_bias: Tensor, weight: Tensor, bias: Tensor
    ) -> Tensor:
        ctx.save_for_backward(x, hidden_weight, hidden_bias, weight)
        out = x.new_empty(len(x), weight.shape[1])
        for span in _spans(x):
            torch.addmm(bias, _hidden(x[span], hidden_weight, hidden_bias), weight, out=out[span])
        return out

    @staticmethod
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor, ...]:
        x, hidden_weight, hidden_bias, weight = ctx.saved_tensors
        full = torch.promote_types(x.dtype, torch.float32)
        grad_x = torch.empty_like(x)
        sums = [torch.zeros_like(value, dtype=full) for value in (hidden_weight, hidden_bias, weight)]
        grad = grad.contiguous()
        for span in _spans(x):
            rows, pull = x[span], grad[span]
            hidden = _hidden(rows, hidden_weight, hidden_bias)
            sums[2].add_(torch.mm(hidden.t(), pull))
            back = torch.ops.aten.threshold_backward(torch.mm(pull, weight.t()), hidden, 0)
            sums[0].add_(torch.mm(rows.t(), back))
            sums[1].add_(back.sum(0, dtype=full))
            torch.mm(back, hidden_weight.t(), out=grad_x[span])
        return grad_x, *(value.to(x.dtype) for value in sums), grad.sum(0)


def _hidden(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    return torch.addmm(bias, x, weight).relu_()


def _spans(x: Tensor) -> list[slice]:
    rows = CPU_ROWS if x.device.type == "cpu" else GPU_ROWS
    return [slice(first, first + rows) for first in range(0, len(x), rows)]
