"""A convolution of images with what follows it: a residual and a ReLU, for inference."""

from __future__ import annotations

import torch
from torch import Tensor

from src.ops.map_conv import conv2d


def conv_relu(
    x: Tensor,  # [M, C, H, W]
    weight: Tensor,  # [C', C, k, k]
    bias: Tensor,  # [C']
    stride: tuple[int, int],
    padding: tuple[int, int],
    residual: Tensor | None = None,  # [M, C', H', W']
) -> Tensor:  # [M, C', H', W']
    """relu(conv2d + residual), without gradient; on a GPU in one launch of cuDNN."""
    if _fuses(x):
        return _fused(x.to(weight.dtype), weight, bias, stride, padding, residual)
    out = conv2d(x, weight, bias, stride[0], padding[0])
    return (out if residual is None else out.add_(residual)).relu_()


def _fuses(x: Tensor) -> bool:
    return x.is_cuda and torch.backends.cudnn.is_available() and torch.backends.cudnn.enabled


def _fused(
    x: Tensor, weight: Tensor, bias: Tensor, stride: tuple[int, int], padding: tuple[int, int], residual: Tensor | None
) -> Tensor:
    sizes = (stride, padding, (1, 1), 1)  # dilation, groups
    if residual is None:
        return torch.cudnn_convolution_relu(x, weight, bias, *sizes)
    return torch.cudnn_convolution_add_relu(x, weight, residual, 1.0, bias, *sizes)
