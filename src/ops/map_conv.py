"""Convolution of images and whole maps, on a CPU in the type and as the products that are fastest there."""

from __future__ import annotations

from itertools import product

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import FunctionCtx, once_differentiable

from src.ops.linear import linear
from src.ops.products import MOST_ROWS, convolution_type, matmul_tn, row_spans, slow_weight_gradients


def conv2d(
    x: Tensor,  # [B, C, H, W]
    weight: Tensor,  # [C', C, k, k]
    bias: Tensor | None = None,  # [C']
    stride: int = 1,
    padding: int = 0,
) -> Tensor:  # [B, C', H', W'] of x's type
    """F.conv2d, whose operands and result are rounded to the type that `convolution_type` chooses."""
    if stride > 1 and padding == 0 and weight.shape[2:] == (1, 1) and weight.shape[1] < 16 and x.device.type == "cpu":
        x, stride = x[:, :, ::stride, ::stride], 1  # oneDNN's backward pass writes beyond its memory there
    dtype = convolution_type(x, weight, stride)
    if dtype == x.dtype:
        return F.conv2d(x, weight, bias, stride, padding)
    return _Conv.apply(x, weight, bias, stride, padding, dtype)


def map_conv2d(
    x: Tensor,  # [B, C, H, W], channels last
    weight: Tensor,  # [C', C, k, k], k odd
    bias: Tensor | None = None,  # [C']
    stride: int = 1,
) -> Tensor:  # [B, C', H / stride, W / stride]
    """F.conv2d with a padding of k // 2. In float32 on a CPU k = 1 is a linear layer on rows of cells.

    With one thread torch convolves those of a small batch without oneDNN and with copies of the input.
    """
    padding = weight.shape[2] // 2
    if x.device.type != "cpu" or x.dtype != torch.float32 or torch.is_autocast_enabled("cpu"):
        return F.conv2d(x, weight, bias, stride, padding)
    if padding == 0:
        cells = x[:, :, ::stride, ::stride].permute(0, 2, 3, 1)  # [B, H', W', C]
        rows = linear(cells.reshape(-1, x.shape[1]), weight.flatten(1).t(), bias)
        return rows.view(*cells.shape[:3], len(weight)).permute(0, 3, 1, 2)
    if slow_weight_gradients() and torch.is_grad_enabled() and weight.requires_grad:
        return _Conv.apply(x, weight, bias, stride, padding, x.dtype)
    return conv2d(x, weight, bias, stride, padding)


class _Conv(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: FunctionCtx,
        x: Tensor,
        weight: Tensor,
        bias: Tensor | None,
        stride: int,
        padding: int,
        dtype: torch.dtype,
    ) -> Tensor:
        own = x.dtype
        x, weight = x.to(dtype), weight.to(dtype)
        ctx.save_for_backward(x, weight)
        ctx.stride, ctx.padding, ctx.dtype = stride, padding, own
        return F.conv2d(x, weight, bias if bias is None else bias.to(dtype), stride, padding).to(own)

    @staticmethod
    @once_differentiable
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor | None, ...]:
        (x, weight), (for_x, for_weight, for_bias) = ctx.saved_tensors, ctx.needs_input_grad[:3]
        grad_bias = grad.sum((0, 2, 3)) if for_bias else None
        grad = grad.to(x.dtype, memory_format=torch.channels_last)
        products = slow_weight_gradients() and ctx.padding == weight.shape[2] // 2
        sizes = [ctx.stride] * 2, [ctx.padding] * 2, [1] * 2, False, [0] * 2, 1
        wanted = [for_x, for_weight and not products, False]
        grad_x, grad_weight, _ = torch.ops.aten.convolution_backward(grad, x, weight, None, *sizes, wanted)
        if for_weight and products:
            grad_weight = weight_gradient(x, grad, weight.shape[2], ctx.stride)
        grads = (one if one is None else one.to(ctx.dtype) for one in (grad_x, grad_weight))
        return *grads, grad_bias, None, None, None


def weight_gradient(
    x: Tensor,  # [B, C, H, W]
    grad: Tensor,  # [B, C', H / stride, W / stride] of the convolution's output
    kernel_size: int,
    stride: int,
) -> Tensor:  # [C', C, k, k]
    """What reaches the weights: for each of the k^2 taps the input under it times the gradient, summed over cells.

    Both lie in rows of cells with a margin of zeros, where a tap is a shift by a number of rows: no map is unfolded.
    With a stride the input is one such map for each cell of a stride's square, of which a tap reads one.
    """
    margin = -(-(kernel_size // 2) // stride)
    size = grad.shape[2:]
    pulls, width = _rows(grad, size, margin), size[1] + 2 * margin
    shifts = [divmod(tap - kernel_size // 2, stride) for tap in range(kernel_size)]  # within a plane, and which
    planes = {
        (row, col): _rows(x[:, :, row::stride, col::stride], size, margin)
        for row, col in product({own for _, own in shifts}, repeat=2)
    }
    sums = x.new_zeros(kernel_size**2, x.shape[1], grad.shape[1])
    edge = margin * (width + 1)
    for span in row_spans(len(pulls) - 2 * edge, MOST_ROWS):
        pull = pulls[edge:][span]
        for total, ((down, row), (right, col)) in zip(sums, product(shifts, repeat=2), strict=True):
            total += matmul_tn(planes[row, col][edge + down * width + right :][span], pull)
    return sums.permute(2, 1, 0).unflatten(2, (kernel_size, kernel_size))


def _rows(
    x: Tensor,  # [B, C, h, w]
    size: tuple[int, int],  # at least (h, w), up to which zeros follow
    margin: int,
) -> Tensor:  # [B * (rows + 2 margin) * (cols + 2 margin), C]
    missing = size[1] - x.shape[3], size[0] - x.shape[2]
    return F.pad(x.permute(0, 2, 3, 1), (0, 0, margin, margin + missing[0], margin, margin + missing[1])).flatten(0, 2)
