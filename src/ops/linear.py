"""A linear layer on many rows."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import FunctionCtx

from src.ops.products import MOST_ROWS, matmul, matmul_tn, product_type, row_spans, whole_steps

LEAST_ROWS = 2048
"""Below, torch's own layer is as fast."""


def linear(
    x: Tensor,  # [n, C]
    weight: Tensor,  # [C, O]
    bias: Tensor | None = None,  # [O]
) -> Tensor:  # [n, O]
    """x W + b; many rows in float32 on a CPU by `matmul`, in the type that `product_type` chooses."""
    plain = x.device.type != "cpu" or x.dtype != torch.float32 or torch.is_autocast_enabled("cpu")
    if plain or len(x) < LEAST_ROWS:
        return x @ weight if bias is None else torch.addmm(bias, x, weight)
    return _Linear.apply(x.contiguous(), weight, bias, product_type(x, weight.shape[1]))


def linear_relu(
    x: Tensor,  # [..., C]
    weight: Tensor,  # [O, C] as a layer has it
    bias: Tensor,  # [O]
) -> Tensor:  # [..., O]
    """relu(x W^T + b), without gradient; on a GPU in one launch. Under autocast the operands are cast by hand."""
    device = x.device.type
    if device == "cpu":
        return F.linear(x, weight, bias).relu_()
    if torch.is_autocast_enabled(device):
        x, weight, bias = (value.to(torch.get_autocast_dtype(device)) for value in (x, weight, bias))
    return torch._addmm_activation(bias, x.reshape(-1, x.shape[-1]), weight.t()).unflatten(0, x.shape[:-1])


class _Linear(torch.autograd.Function):
    @staticmethod
    def forward(ctx: FunctionCtx, x: Tensor, weight: Tensor, bias: Tensor | None, dtype: torch.dtype) -> Tensor:
        ctx.save_for_backward(x, weight)
        ctx.dtype = dtype
        out = _times(x, weight, dtype)
        return out if bias is None else out.add_(bias)

    @staticmethod
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor | None, ...]:
        (x, weight), dtype, grad = ctx.saved_tensors, ctx.dtype, grad.contiguous()
        grad_x = grad_weight = None
        if ctx.needs_input_grad[0]:
            grad_x = _times(grad, weight.t(), dtype)
        if ctx.needs_input_grad[1]:
            grad_weight = torch.zeros_like(weight)
            for span in row_spans(len(x), MOST_ROWS):
                grad_weight += matmul_tn(whole_steps(x[span]).to(dtype), whole_steps(grad[span]).to(dtype))
        return grad_x, grad_weight, grad.sum(0) if ctx.needs_input_grad[2] else None, None


def _times(x: Tensor, weight: Tensor, dtype: torch.dtype) -> Tensor:
    out, weight = x.new_empty(len(x), weight.shape[1]), weight.to(dtype)
    for span in row_spans(len(x), MOST_ROWS):
        out[span] = matmul(whole_steps(x[span]).to(dtype), weight)[: len(x[span])]
    return out
