"""Sparse convolution on sets of sites: the operation, its formula, and the branch by device and type."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from src.ops.backend import COUNTED, chosen, implementation
from src.ops.kernel_map import KernelMap
from src.ops.linear import linear
from src.ops.segment_reduce import gather_segment_sum
from src.ops.sparse_conv_cpu import cpu_sparse_conv
from src.ops.sparse_conv_grouped import GROUPED_DTYPES, grouped_sparse_conv


def sparse_conv(
    features: Tensor,  # [M_in, Cin]
    weight: Tensor,  # [K, Cin, Cout], offsets in C order over the kernel axes
    kernel_map: KernelMap,
    bias: Tensor | None = None,  # [Cout]
) -> Tensor:  # [M_out, Cout]
    """Convolve the features of a set of sites (correlation, as torch): y_o = b + sum over pairs (i, o, k) of x_i W_k.

    A dense weight [Cout, Cin, k...] becomes ours by `weight.flatten(2).permute(2, 1, 0)`. Under autocast the operands
    are cast to its type by hand, since the grouped product is not on autocast's list. The backward pass keeps the
    features and the weight only, never one row per pair. Raises ValueError for shapes or types that do not fit.
    """
    features, weight, bias = _operands(features, weight, kernel_map, bias)
    return implementation(sparse_conv_reference)(features, weight, kernel_map, bias)


@torch.no_grad()
def sparse_conv_relu(
    features: Tensor,  # [M_in, Cin]
    weight: Tensor,  # [K, Cin, Cout]
    kernel_map: KernelMap,
    bias: Tensor | None = None,  # [Cout]
    residual: Tensor | None = None,  # [M_out, Cout]
) -> Tensor:  # [M_out, Cout]
    """relu(`sparse_conv` + residual), without gradient, for inference: on a GPU in one launch."""
    features, weight, bias = _operands(features, weight, kernel_map, bias)
    return implementation(sparse_conv_relu_reference)(features, weight, kernel_map, bias, residual)


def sparse_conv_relu_reference(
    features: Tensor, weight: Tensor, kernel_map: KernelMap, bias: Tensor | None, residual: Tensor | None
) -> Tensor:
    """The operations one after the other."""
    out = sparse_conv_reference(features, weight, kernel_map, bias)
    return (out if residual is None else out.add_(residual)).relu_()


def _operands(
    features: Tensor, weight: Tensor, kernel_map: KernelMap, bias: Tensor | None
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Features, weight and bias in the type of the products."""
    if torch.is_autocast_enabled(features.device.type) and features.dtype != torch.float64:
        dtype = torch.get_autocast_dtype(features.device.type)
        features, weight = features.to(dtype), weight.to(dtype)
        bias = None if bias is None else bias.to(dtype)
    _check(features, weight, kernel_map, bias)
    return features, weight, bias


@torch.no_grad()
def neighbour_sum(
    features: Tensor,  # [M_in, C]
    kernel_map: KernelMap,
) -> Tensor:  # [M_out, C]
    """Sum of the input rows that each output sees: the convolution whose weights are all one. Without gradient."""
    if features.device.type != "cpu":  # whose maps are tables
        table = kernel_map.table.t()  # [M_out, K]
        return F.embedding_bag(table + 1, F.pad(features, (0, 0, 1, 0)), mode="sum")
    order, starts = kernel_map.by_output
    return gather_segment_sum(features, kernel_map.inputs.index_select(0, order), starts)


def sparse_conv_reference(
    features: Tensor,  # [M_in, Cin]
    weight: Tensor,  # [K, Cin, Cout]
    kernel_map: KernelMap,
    bias: Tensor | None,  # [Cout]
) -> Tensor:  # [M_out, Cout]
    """Torch's form by device and type; a kernel of one offset is a linear layer."""
    if kernel_map.identity:
        return linear(features, weight[0], bias)
    if features.device.type == "cpu" and chosen() != COUNTED:  # it multiplies by zeros
        return cpu_sparse_conv(features, weight, kernel_map, bias)
    if features.dtype in GROUPED_DTYPES:
        return grouped_sparse_conv(features, weight, kernel_map, bias)
    return plain_sparse_conv(features, weight, kernel_map, bias)


def plain_sparse_conv(
    features: Tensor,  # [M_in, Cin]
    weight: Tensor,  # [K, Cin, Cout]
    kernel_map: KernelMap,
    bias: Tensor | None,  # [Cout]
) -> Tensor:  # [M_out, Cout]
    """The formula offset by offset: gather, matmul, scatter; keeps a row per pair for the backward pass.

    An output meets each offset at most once, so no sum depends on the order in which a GPU adds.
    """
    out = features.new_zeros(kernel_map.num_outputs, weight.shape[2])
    blocks = zip(kernel_map.inputs.split(kernel_map.counts), kernel_map.outputs.split(kernel_map.counts), strict=True)
    for matrix, (inputs, outputs) in zip(weight, blocks, strict=True):
        out = out.index_add(0, outputs, features.index_select(0, inputs) @ matrix)
    return out if bias is None else out + bias


def _check(features: Tensor, weight: Tensor, kernel_map: KernelMap, bias: Tensor | None) -> None:
    if features.dim() != 2 or weight.dim() != 3 or features.shape[1] != weight.shape[1]:
        raise ValueError(
            f"expected features [M, Cin] and weight [K, Cin, Cout], got {list(features.shape)} and {list(weight.shape)}"
        )
    if len(features) != kernel_map.num_inputs or len(weight) != kernel_map.num_offsets:
        raise ValueError(
            f"the kernel map joins {kernel_map.num_inputs} rows through {kernel_map.num_offsets} offsets, got "
            f"{len(features)} rows and {len(weight)} offsets; build the map from the sites of these features"
        )
    if features.dtype != weight.dtype or (bias is not None and bias.dtype != weight.dtype):
        raise ValueError(f"features are {features.dtype} but weights {weight.dtype}; cast one of them")
