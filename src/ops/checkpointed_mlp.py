"""A two-layer perceptron on many rows, checkpointed: the hidden layer is recomputed in the backward pass."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor
from torch.autograd.function import FunctionCtx

from src.ops.products import matmul, matmul_tn, product_type, row_spans, whole_steps

CPU_ROWS = 1024
GPU_VALUES = 1 << 28
"""Rows of a chunk on a CPU, where its hidden layer stays in the cache; its values on a GPU, which bound the memory."""


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
    metres per second be rounded; products in bfloat16 likewise. Gradients of weights are summed in float32 at least.
    """
    hidden = (x, hidden_weight, hidden_bias)
    if torch.is_autocast_enabled(x.device.type) and x.dtype != torch.float64:
        hidden = tuple(value.to(torch.get_autocast_dtype(x.device.type)) for value in hidden)
    full = torch.promote_types(x.dtype, torch.float32)
    dtype = product_type(hidden[0], hidden_weight.shape[1])
    return _CheckpointedMLP.apply(*hidden, weight.to(full), bias.to(full), dtype)


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
        ctx: FunctionCtx,
        x: Tensor,
        hidden_weight: Tensor,
        hidden_bias: Tensor,
        weight: Tensor,
        bias: Tensor,
        dtype: torch.dtype,  # of the operands of products
    ) -> Tensor:
        ctx.save_for_backward(x, hidden_weight, hidden_bias, weight)
        ctx.dtype = dtype
        first = hidden_weight.to(dtype), hidden_bias.to(dtype)
        out = weight.new_empty(len(x), weight.shape[1])
        for span in _spans(x, hidden_weight.shape[1]):
            hidden = matmul(whole_steps(x[span]).to(dtype), *first, relu=True)
            out[span] = matmul(hidden.to(weight.dtype), weight, bias)[: len(out[span])]
        return out

    @staticmethod
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor | None, ...]:
        x, hidden_weight, hidden_bias, weight = ctx.saved_tensors
        dtype, full = ctx.dtype, weight.dtype
        first, second = (hidden_weight.to(dtype), hidden_bias.to(dtype)), weight.to(dtype)
        grad_x = torch.empty_like(x)
        sums = [torch.zeros_like(value, dtype=full) for value in (hidden_weight, hidden_bias, weight)]
        for span in _spans(x, hidden_weight.shape[1]):
            rows, pull = whole_steps(x[span]).to(dtype), whole_steps(grad[span]).to(dtype).contiguous()
            hidden = matmul(rows, *first, relu=True)
            sums[2].add_(matmul_tn(hidden, pull))
            back = torch.ops.aten.threshold_backward(matmul(pull, second.t()), hidden, 0)
            sums[0].add_(matmul_tn(rows, back))
            sums[1].add_(back.sum(0))
            grad_x[span] = matmul(back, first[0].t())[: len(x[span])]
        return grad_x, sums[0].to(x.dtype), sums[1].to(x.dtype), sums[2], grad.sum(0), None


def _spans(x: Tensor, width: int) -> Iterator[slice]:
    return row_spans(len(x), CPU_ROWS if x.device.type == "cpu" else max(1, GPU_VALUES // width))
