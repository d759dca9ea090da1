"""Layers that lie side by side as one layer, for inference."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from src.models.layers.sparse import SubmanifoldConv
from src.ops.conv_relu import conv_relu
from src.ops.linear import linear_relu


class LinearReLU(nn.Linear):
    """A linear layer and the ReLU behind it, without gradient."""

    def forward(
        self,
        x: Tensor,  # [..., C]
    ) -> Tensor:  # [..., C']
        return linear_relu(x, self.weight, self.bias)


class ConvReLU(nn.Conv2d):
    """A convolution, what is added to it and the ReLU behind both, without gradient."""

    def forward(
        self,
        x: Tensor,  # [M, C, H, W]
        residual: Tensor | None = None,  # [M, C', H', W']
    ) -> Tensor:  # [M, C', H', W']
        return conv_relu(x, self.weight, self.bias, self.stride, self.padding, residual)


def with_relu(layer: nn.Linear | nn.Conv2d) -> LinearReLU | ConvReLU:
    """The layer with a ReLU behind it, of the same weights. Convolutions are neither dilated nor grouped."""
    if isinstance(layer, nn.Linear):
        return joined_linear(layer.weight, layer.bias, LinearReLU)
    sizes = (layer.in_channels, layer.out_channels, layer.kernel_size, layer.stride, layer.padding)
    merged = ConvReLU(*sizes, device="meta")
    merged.weight, merged.bias = layer.weight, layer.bias
    return merged


def joined_convs(convs: Sequence[SubmanifoldConv]) -> SubmanifoldConv:
    """One convolution with the outputs of all side by side; they read the same input."""
    first, widths = convs[0], [conv.out_channels for conv in convs]
    joined = SubmanifoldConv(first.in_channels, sum(widths), first.kernel_size, first.ndim, bias=True)
    joined.weight.data = torch.cat([conv.weight for conv in convs], dim=2)
    joined.bias.data = torch.cat([conv.bias for conv in convs])
    return joined.requires_grad_(False).eval()


def block_diagonal(layers: Sequence[nn.Linear]) -> nn.Linear:
    """One layer of their kind that maps the inputs of all, side by side, to the outputs of all."""
    weight, bias = torch.block_diag(*(x.weight for x in layers)), torch.cat([x.bias for x in layers])
    return joined_linear(weight, bias, type(layers[0]))


def joined_linear(
    weight: Tensor,  # [out, in]
    bias: Tensor,  # [out]
    kind: type[nn.Linear] = nn.Linear,
) -> nn.Linear:
    """A linear layer of these values, without gradient."""
    layer = kind(weight.shape[1], weight.shape[0], device="meta")
    layer.weight, layer.bias = (nn.Parameter(value, requires_grad=False) for value in (weight, bias))
    return layer
