"""The gradients of a sparse convolution, whoever makes its products."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.autograd.function import FunctionCtx

from src.ops.kernel_map import KernelMap


class SparseConvFunction(torch.autograd.Function):
    """y_o = b + sum over pairs (i, o, k) of x_i W_k; keeps the features and the weight for the backward pass.

    `convolve(features, weight, bias, kernel_map)` makes y; `gradients(features, weight, grad, kernel_map, needed)`
    makes dL/dx_i = sum of dL/dy_o W_k^T and dL/dW_k = sum of x_i^T dL/dy_o, `needed` saying which of the two.
    """

    @staticmethod
    def forward(
        ctx: FunctionCtx,
        features: Tensor,  # [M_in, Cin]
        weight: Tensor,  # [K, Cin, Cout]
        bias: Tensor | None,  # [Cout]
        kernel_map: KernelMap,
        convolve: Callable[..., Tensor],
        gradients: Callable[..., tuple[Tensor | None, Tensor | None]],
    ) -> Tensor:  # [M_out, Cout]
        weight = weight.contiguous()
        ctx.save_for_backward(features, weight)
        ctx.kernel_map, ctx.gradients = kernel_map, gradients
        return convolve(features, weight, bias, kernel_map)

    @staticmethod
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor | None, ...]:
        *needed, need_bias = ctx.needs_input_grad[:3]
        grad = grad.contiguous()
        found = ctx.gradients(*ctx.saved_tensors, grad, ctx.kernel_map, needed) if any(needed) else (None, None)
        return *found, grad.sum(0) if need_bias else None, None, None, None
