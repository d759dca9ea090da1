"""Sparse convolution on sets of sites: gather, one matrix product per kernel offset, segment sum."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import FunctionCtx

from src.ops.backend import implementation, register
from src.ops.kernel_maps import KernelMap
from src.ops.segment_reduce import gather_segment_sum
from src.ops.tiled_rulebook import scratch, tiled_rulebook

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
    order, starts = kernel_map.segments_by_output()
    return gather_segment_sum(features, kernel_map.inputs.index_select(0, order), starts)


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
    """Gather by input -> one product per offset -> sum by output, and the transposed way back."""

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
        if _is_grouped(features):
            picks, segments = kernel_map.inputs, kernel_map.segments_by_output()
            out = _gather_multiply_sum(features, weight, picks, kernel_map, segments)
        else:
            out, _ = _tiled(features, weight, kernel_map, backward=False)
        return out if bias is None else out.add_(bias)

    @staticmethod
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor | None, Tensor | None, Tensor | None, None]:
        features, weight = ctx.saved_tensors
        maps: KernelMap = ctx.kernel_map
        grad = grad.contiguous()
        need_features, need_weight, need_bias, _ = ctx.needs_input_grad
        grad_features = grad_weight = None
        if not _is_grouped(features):
            if need_features or need_weight:
                others = features if need_weight else None
                grad_features, grad_weight = _tiled(grad, weight, maps, backward=True, others=others)
        else:
            if need_features and maps.mirrored:
                # The transposed map is the map itself with reversed offsets, whose segments exist already.
                back = weight.flip(0).transpose(1, 2)
                grad_features = _gather_multiply_sum(grad, back, maps.inputs, maps, maps.segments_by_output())
            elif need_features:
                back = weight.transpose(1, 2)
                grad_features = _gather_multiply_sum(grad, back, maps.outputs, maps, maps.segments_by_input())
            if need_weight:
                grad_weight = _weight_gradient(features, grad, maps)
        return grad_features, grad_weight, grad.sum(0) if need_bias else None, None


def _is_grouped(rows: Tensor) -> bool:
    """Whether all offsets go into one kernel launch over all pairs, as on a GPU, or tile by tile through a cache."""
    return rows.device.type != "cpu" and rows.dtype in GROUPED_DTYPES


def _tiled(
    rows: Tensor,  # [n, Ca] features, or backward the gradient of the output
    weight: Tensor,  # [K, Cin, Cout]
    kernel_map: KernelMap,
    backward: bool,
    others: Tensor | None = None,  # [m, Cin] the features, if backward is to make the gradient of the weight
) -> tuple[Tensor, Tensor | None]:  # [m, Cb], [K, Cin, Cout]
    """Convolution, or both its gradients, with every temporary in reused memory of a cache's size.

    Backward, a tile's gathered gradients serve the features and the weight.
    """
    num = kernel_map.num_inputs if backward else kernel_map.num_outputs
    matrices = (weight.transpose(1, 2) if backward else weight).unbind(0)
    width_in, width = matrices[0].shape
    # Sums over tiles in float32 at least: half precision would swallow the last ones.
    full = torch.promote_types(weight.dtype, torch.float32)
    grad_weight = None if others is None else torch.zeros_like(weight, dtype=full)
    gradients = () if grad_weight is None else grad_weight.unbind(0)
    centre = kernel_map.centre
    if centre is None:
        out = rows.new_empty(num, width)
    else:
        out = torch.mm(rows, matrices[centre])
        if others is not None:
            gradients[centre].add_(torch.mm(others.t(), rows))
    if backward and kernel_map.mirrored:  # the tiles are those of the way forward
        matrices, gradients = matrices[::-1], gradients[::-1]
    cut = tiled_rulebook(kernel_map, backward, width_in + width, rows.dtype)
    gathered_rows = scratch("gathered", cut.most_pairs, width_in, rows.dtype, rows.device)
    products = scratch("products", cut.most_pairs, width, rows.dtype, rows.device)
    for tile in cut.tiles:
        gathered = torch.index_select(rows, 0, tile.gathered, out=gathered_rows[: len(tile.gathered)])
        for offset, first, last in tile.spans:
            torch.mm(gathered[first:last], matrices[offset], out=products[first:last])
        sums = gather_segment_sum(products, tile.order, tile.starts)
        block = out[tile.first : tile.last]
        if centre is None:
            block.copy_(sums)
        else:
            block.add_(sums)
        if others is not None:
            partners = torch.index_select(others, 0, tile.summed, out=products[: len(tile.summed)])
            for offset, first, last in tile.spans:
                product = torch.mm(partners[first:last].t(), gathered[first:last])  # addmm_ is slow in bfloat16
                gradients[offset].add_(product)
    return out, None if grad_weight is None else grad_weight.to(weight.dtype)


def _gather_multiply_sum(
    rows: Tensor,  # [n, Ca]
    weight: Tensor,  # [K, Ca, Cb]
    picks: Tensor,  # [pairs] int32
    kernel_map: KernelMap,
    segments: tuple[Tensor, Tensor],
) -> Tensor:  # [number of segments, Cb]
    if len(picks) == 0:
        return rows.new_zeros(len(segments[1]) - 1, weight.shape[2])
    width = weight.shape[2]
    # Rows of a grouped product must be multiples of 16 bytes.
    rows, weight = _padded(rows, 1), _padded(_padded(weight, 1), 2)
    products = F.grouped_mm(F.embedding(picks, rows), weight, offs=kernel_map.ends())
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
    return F.grouped_mm(left.t(), right, offs=kernel_map.ends())[:, :c_in, :c_out]


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
