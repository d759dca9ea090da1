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
) -> Tensor:  # [n, O] float32 at least
    """relu(x W + b) V + c in chunks of rows, differentiable in all operands.

    Recomputing the hidden layer costs one product, keeping it [n, H] of memory, written and read several times.
    Under autocast x and the hidden layer are of its type, cast by hand; the outputs are not, since scores would tie and
    metres per second be rounded. Gradients of weights are summed in float32 at least.
    """
    hidden = (x, hidden_weight, hidden_bias)
    if torch.is_autocast_enabled(x.device.type) and x.dtype != torch.float64:
        hidden = tuple(value.to(torch.get_autocast_dtype(x.device.type)) for value in hidden)
    full = torch.promote_types(x.dtype, torch.float32)
    return _CheckpointedMLP.apply(*hidden, weight.to(full), bias.to(full))


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
        out = weight.new_empty(len(x), weight.shape[1])
        for span in _spans(x):
            torch.addmm(bias, _hidden(x[span], hidden_weight, hidden_bias).to(weight.dtype), weight, out=out[span])
        return out

    @staticmethod
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor, ...]:
        x, hidden_weight, hidden_bias, weight = ctx.saved_tensors
        full = weight.dtype
        grad_x = torch.empty_like(x)
        sums = [torch.zeros_like(value, dtype=full) for value in (hidden_weight, hidden_bias, weight)]
        pulls, out_weight = grad.to(x.dtype).contiguous(), weight.to(x.dtype)
        for span in _spans(x):
            rows, pull = x[span], pulls[span]
            hidden = _hidden(rows, hidden_weight, hidden_bias)
            sums[2].add_(torch.mm(hidden.t(), pull))
            back = torch.ops.aten.threshold_backward(torch.mm(pull, out_weight.t()), hidden, 0)
            sums[0].add_(torch.mm(rows.t(), back))
            sums[1].add_(back.sum(0, dtype=full))
            torch.mm(back, hidden_weight.t(), out=grad_x[span])
        return grad_x, sums[0].to(x.dtype), sums[1].to(x.dtype), sums[2], grad.sum(0)


def _hidden(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    return torch.addmm(bias, x, weight).relu_()


def _spans(x: Tensor) -> list[slice]:
    rows = CPU_ROWS if x.device.type == "cpu" else GPU_ROWS
    return [slice(first, first + rows) for first in range(0, len(x), rows)]
