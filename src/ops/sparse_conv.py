"""Sparse convolution on sets of sites: gather, one matrix product per kernel offset, segment sum."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import FunctionCtx

from src.ops.backend import implementation, register
from src.ops.bags import bag_sum
from src.ops.kernel_maps import KernelMap, strided_map, submanifold_map, temporal_map
from src.ops.sites import Sites, union

__all__ = [
    "KernelMap",
    "Sites",
    "neighbour_sum",
    "sparse_conv",
    "strided_map",
    "submanifold_map",
    "temporal_map",
    "union",
]

# Types of the grouped product, one kernel launch for all offsets; others, and torch without it, go offset by offset.
GROUPED_DTYPES = (torch.float32, torch.bfloat16, torch.float16) if hasattr(F, "grouped_mm") else ()


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
    if torch.is_autocast_enabled(features.device.type) and features.dtype != torch.float64:
        dtype = torch.get_autocast_dtype(features.device.type)
        features, weight = features.to(dtype), weight.to(dtype)
        bias = None if bias is None else bias.to(dtype)
    _check(features, weight, kernel_map, bias)
    return implementation("sparse_conv")(features, weight, kernel_map, bias)


@torch.no_grad()
def neighbour_sum(
    features: Tensor,  # [M_in, C]
    kernel_map: KernelMap,
) -> Tensor:  # [M_out, C]
    """Sum of the input rows that each output sees: the convolution whose weights are all one. Without gradient."""
    order, starts = kernel_map.bags_by_output()
    return bag_sum(features, kernel_map.inputs.index_select(0, order), starts)


@register("sparse_conv", "reference")
def sparse_conv_reference(
    features: Tensor,  # [M_in, Cin]
    weight: Tensor,  # [K, Cin, Cout]
    kernel_map: KernelMap,
    bias: Tensor | None,  # [Cout]
) -> Tensor:  # [M_out, Cout]
    """Plain torch form; a kernel of one offset is a linear layer."""
    if kernel_map.identity:
        return features @ weight[0] if bias is None else torch.addmm(bias, features, weight[0])
    return _SparseConv.apply(features, weight, bias, kernel_map)


class _SparseConv(torch.autograd.Function):
    """Gather by input -> grouped product -> sum by output, and the transposed way back."""

    @staticmethod
    def forward(
        ctx: FunctionCtx,
        features: Tensor,
        weight: Tensor,
        bias: Tensor | None,
        kernel_map: KernelMap,
    ) -> Tensor:
        weight = weight.contiguous()  # the grouped product takes plain row- or column-major matrices only
        ctx.save_for_backward(features, weight)
        ctx.kernel_map = kernel_map
        out = _gather_multiply_sum(features, weight, kernel_map.inputs, kernel_map, kernel_map.bags_by_output())
        return out if bias is None else out.add_(bias)

    @staticmethod
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor | None, Tensor | None, Tensor | None, None]:
        features, weight = ctx.saved_tensors
        maps: KernelMap = ctx.kernel_map
        grad = grad.contiguous()
        grad_features = grad_weight = grad_bias = None
        if ctx.needs_input_grad[0]:
            if maps.mirrored:
                # The transposed map is the map itself with reversed offsets, whose bags exist already.
                back = weight.flip(0).transpose(1, 2)
                grad_features = _gather_multiply_sum(grad, back, maps.inputs, maps, maps.bags_by_output())
            else:
                back = weight.transpose(1, 2)
                grad_features = _gather_multiply_sum(grad, back, maps.outputs, maps, maps.bags_by_input())
        if ctx.needs_input_grad[1]:
            grad_weight = _weight_gradient(features, grad, maps)
        if ctx.needs_input_grad[2]:
            grad_bias = grad.sum(0)
        return grad_features, grad_weight, grad_bias, None


def _gather_multiply_sum(
    rows: Tensor,  # [n, Ca]
    weight: Tensor,  # [K, Ca, Cb]
    picks: Tensor,  # [pairs] int32
    kernel_map: KernelMap,
    bags: tuple[Tensor, Tensor],
) -> Tensor:  # [number of bags, Cb]
    if len(picks) == 0:
        return rows.new_zeros(len(bags[1]) - 1, weight.shape[2])
    width = weight.shape[2]
    if rows.dtype in GROUPED_DTYPES:
        # Rows of a grouped product must be multiples of 16 bytes.
        rows, weight = _padded(rows, 1), _padded(_padded(weight, 1), 2)
        products = F.grouped_mm(F.embedding(picks, rows), weight, offs=kernel_map.ends())
    else:
        products = rows.new_empty(len(picks), width)
        gathered = F.embedding(picks, rows)
        for block, matrix, out in zip(
            gathered.split(kernel_map.counts), weight, products.split(kernel_map.counts), strict=True
        ):
            torch.mm(block, matrix, out=out)
    order, starts = bags
    out = bag_sum(products, order, starts)
    return out if out.shape[1] == width else out[:, :width].contiguous()


def _weight_gradient(
    features: Tensor,  # [M_in, Cin]
    grad: Tensor,  # [M_out, Cout]
    kernel_map: KernelMap,
) -> Tensor:  # [K, Cin, Cout]
    c_in, c_out = features.shape[1], grad.shape[1]
    if len(kernel_map.inputs) == 0:
        return features.new_zeros(kernel_map.num_offsets, c_in, c_out)
    if features.dtype in GROUPED_DTYPES:
        left = F.embedding(kernel_map.inputs, _padded(features, 1))
        right = F.embedding(kernel_map.outputs, _padded(grad, 1))
        return F.grouped_mm(left.t(), right, offs=kernel_map.ends())[:, :c_in, :c_out]
    left, right = F.embedding(kernel_map.inputs, features), F.embedding(kernel_map.outputs, grad)
    blocks = zip(left.split(kernel_map.counts), right.split(kernel_map.counts), strict=True)
    return torch.stack([a.t() @ b for a, b in blocks])


def _padded(x: Tensor, axis: int) -> Tensor:
    """The tensor with zeros appended along an axis until a row has a multiple of 16 bytes."""
    missing = -x.shape[axis] % (16 // x.element_size())
    if not missing:
        return x
    return F.pad(x, (0, 0) * (x.dim() - 1 - axis) + (0, missing))


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
