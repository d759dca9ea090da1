"""Sparse convolution with one grouped matrix product over all kernel offsets: torch's form for a GPU."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from src.ops.kernel_map import KernelMap
from src.ops.segment_reduce import gather_segment_sum
from src.ops.sparse_conv_function import SparseConvFunction

# Types of the grouped product, where this torch has it.
GROUPED_DTYPES = (torch.float32, torch.bfloat16, torch.float16) if hasattr(F, "grouped_mm") else ()


def grouped_sparse_conv(
    features: Tensor,  # [M_in, Cin] of a type in GROUPED_DTYPES
    weight: Tensor,  # [K, Cin, Cout]
    kernel_map: KernelMap,
    bias: Tensor | None,  # [Cout]
) -> Tensor:  # [M_out, Cout]
    """`sparse_conv` as gather by input, one launch for the products of all offsets, segment sum by output."""
    return SparseConvFunction.apply(features, weight, bias, kernel_map, _forward, _gradients)


def _forward(features: Tensor, weight: Tensor, bias: Tensor | None, kernel_map: KernelMap) -> Tensor:
    out = _gather_multiply_sum(features, weight, kernel_map.inputs, kernel_map, kernel_map.by_output)
    return out if bias is None else out.add_(bias)


def _gradients(
    features: Tensor, weight: Tensor, grad: Tensor, maps: KernelMap, needed: list[bool]
) -> tuple[Tensor | None, Tensor | None]:
    grad_features = None
    if needed[0] and maps.mirrored:
        # The transposed map is the map itself with reversed offsets, whose segments exist already.
        back = weight.flip(0).transpose(1, 2)
        grad_features = _gather_multiply_sum(grad, back, maps.inputs, maps, maps.by_output)
    elif needed[0]:
        back = weight.transpose(1, 2)
        grad_features = _gather_multiply_sum(grad, back, maps.outputs, maps, maps.by_input)
    return grad_features, _weight_gradient(features, grad, maps) if needed[1] else None


def _gather_multiply_sum(
    rows: Tensor,  # [n, Ca]
    weight: Tensor,  # [K, Ca, Cb]
    gathered: Tensor,  # [pairs] int32, row of each pair
    kernel_map: KernelMap,
    segments: tuple[Tensor, Tensor],
) -> Tensor:  # [number of segments, Cb]
    if len(gathered) == 0:
        return rows.new_zeros(len(segments[1]) - 1, weight.shape[2])
    width = weight.shape[2]
    # Rows of a grouped product must be multiples of 16 bytes.
    rows, weight = _padded(rows, 1), _padded(_padded(weight, 1), 2)
    products = F.grouped_mm(F.embedding(gathered, rows), weight, offs=kernel_map.ends)
    order, starts = segments
    out = gather_segment_sum(products, order, starts)
    return out if out.shape[1] == width else out[:, :width].contiguous()


def _weight_gradient(
    features: Tensor,  # [M_in, Cin]
    grad: Tensor,  # [M_out, Cout]
    kernel_map: KernelMap,
) -> Tensor:  # [K, Cin, Cout]
    c_in, c_out = features.shape[1], grad.shape[1]
    if len(kernel_map.inputs) == 0:
        return features.new_zeros(kernel_map.num_offsets, c_in, c_out)
    left = F.embedding(kernel_map.inputs, _padded(features, 1))
    right = F.embedding(kernel_map.outputs, _padded(grad, 1))
    return F.grouped_mm(left.t(), right, offs=kernel_map.ends)[:, :c_in, :c_out]


def _padded(x: Tensor, axis: int) -> Tensor:
    """The tensor with zeros appended along an axis until a row has a multiple of 16 bytes."""
    missing = -x.shape[axis] % (16 // x.element_size())
    if not missing:
        return x
    return F.pad(x, (0, 0) * (x.dim() - 1 - axis) + (0, missing))
