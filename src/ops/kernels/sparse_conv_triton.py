"""Sparse convolution as implicit GEMM in Triton: rows are gathered straight into the product."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from src.ops.backend import interpreted, runs_kernels
from src.ops.kernel_map import KernelMap
from src.ops.sparse_conv import sparse_conv_reference, sparse_conv_relu_reference
from src.ops.sparse_conv_function import SparseConvFunction

DTYPES = (torch.float32, torch.float16, torch.bfloat16)
# Output rows a program computes, and rows it multiplies at a time for the gradient of the weights.
ROWS = 64
PAIRS = 64
# Tile edges: powers of two from 16, the least a tensor core takes, to what three stages keep in shared memory, and a
# program in registers without spilling one (sm_80, sm_86).
LEAST_TILE = 16
MOST_OUT = {torch.float32: 64, torch.float16: 128, torch.bfloat16: 128}
MOST_DEPTH = {torch.float32: 32, torch.float16: 64, torch.bfloat16: 64}
MOST_SQUARE = 64
# The table is cut into about this many spans of a tap's rows, each with a partial gradient of the weights, but into
# none shorter than...
SPANS = 256
LEAST_SPAN = 512


def sparse_conv_triton(
    features: Tensor,  # [M_in, Cin]
    weight: Tensor,  # [K, Cin, Cout]
    kernel_map: KernelMap,
    bias: Tensor | None,  # [Cout]
) -> Tensor:  # [M_out, Cout]
    """The reference's sums in float32, in one launch forward and three backward; a linear layer stays one."""
    if kernel_map.identity or features.dtype not in DTYPES or not runs_kernels(features):
        return sparse_conv_reference(features, weight, kernel_map, bias)
    return SparseConvFunction.apply(features.contiguous(), weight, bias, kernel_map, _forward, _gradients)


def sparse_conv_relu_triton(
    features: Tensor,  # [M_in, Cin]
    weight: Tensor,  # [K, Cin, Cout]
    kernel_map: KernelMap,
    bias: Tensor | None,  # [Cout]
    residual: Tensor | None,  # [M_out, Cout]
) -> Tensor:  # [M_out, Cout]
    """The reference's sums in float32, in one launch."""
    if kernel_map.identity or features.dtype not in DTYPES or not runs_kernels(features):
        return sparse_conv_relu_reference(features, weight, kernel_map, bias, residual)
    return _product(features.contiguous(), weight, kernel_map, bias, residual, relu=True)


def _forward(features: Tensor, weight: Tensor, bias: Tensor | None, kernel_map: KernelMap) -> Tensor:
    return _product(features, weight, kernel_map, bias)


def _gradients(
    features: Tensor, weight: Tensor, grad: Tensor, maps: KernelMap, needed: list[bool]
) -> tuple[Tensor | None, Tensor | None]:
    grad_features = None
    if needed[0]:
        # A mirrored map is its own transpose once the taps are reversed.
        own = maps if maps.mirrored else maps.transposed
        grad_features = _product(grad, weight.transpose(1, 2), own, None, reverse=maps.mirrored)
    return grad_features, _weight_gradient(features, grad, maps) if needed[1] else None


def _product(
    rows: Tensor,  # [m, Ca]
    weight: Tensor,  # [K, Ca, Cb], any strides
    kernel_map: KernelMap,  # of n rows among m
    bias: Tensor | None,  # [Cb]
    residual: Tensor | None = None,  # [n, Cb]
    relu: bool = False,
    reverse: bool = False,  # the last tap has the first matrix
) -> Tensor:  # [n, Cb]
    num, (_, c_in, c_out) = kernel_map.num_outputs, weight.shape
    out = rows.new_empty(num, c_out)
    if out.numel() == 0:
        return out
    depth, width = _tile(c_in, MOST_DEPTH[rows.dtype]), _tile(c_out, MOST_OUT[rows.dtype])
    with torch.cuda.device_of(rows):
        _gather_product[(triton.cdiv(num, ROWS), triton.cdiv(c_out, width))](
            rows,
            weight,
            out if bias is None else bias.contiguous(),
            out if residual is None else residual.contiguous(),
            out,
            *(kernel_map.order, kernel_map.table, relu, reverse),
            *(num, len(weight), c_in, c_out, *weight.stride()),
            HAS_BIAS=bias is not None,
            HAS_RESIDUAL=residual is not None,
            PRECISION=_precision(),
            UPCAST=_upcast(rows),
            DEPTHS=triton.cdiv(c_in, depth),
            BLOCK_ROWS=ROWS,
            BLOCK_IN=depth,
            BLOCK_OUT=width,
            num_warps=4,
            num_stages=3,
            enable_fp_fusion=True,
        )
    return out


@triton.jit
def _add_product(left, right, total, PRECISION: tl.constexpr, UPCAST: tl.constexpr):  # noqa: ANN001, ANN202
    if UPCAST:
        left, right = left.to(tl.float32), right.to(tl.float32)
    return tl.dot(left, right, total, input_precision=PRECISION)


@triton.jit(do_not_specialize=["num", "all_taps"])
def _gather_product(  # noqa: ANN202
    rows, weight, bias, residual, out, order, table,  # noqa: ANN001
    RELU: tl.constexpr, REVERSE: tl.constexpr,
    num, all_taps, c_in, c_out, stride_tap, stride_in, stride_out,  # noqa: ANN001
    HAS_BIAS: tl.constexpr, HAS_RESIDUAL: tl.constexpr, PRECISION: tl.constexpr, UPCAST: tl.constexpr,
    DEPTHS: tl.constexpr, BLOCK_ROWS: tl.constexpr, BLOCK_IN: tl.constexpr, BLOCK_OUT: tl.constexpr,
):  # fmt: skip
    """One block of output rows and channels: walks the taps through which a row of the block sees anything."""
    place = tl.program_id(0) * BLOCK_ROWS + tl.arange(0, BLOCK_ROWS)
    column = tl.program_id(1) * BLOCK_OUT + tl.arange(0, BLOCK_OUT)
    lane = tl.arange(0, BLOCK_IN)
    target = tl.load(order + place, mask=place < num, other=0)
    total = tl.zeros((BLOCK_ROWS, BLOCK_OUT), tl.float32)
    for tap in range(0, all_taps):
        row = tl.load(table + tap * num + target, mask=place < num, other=-1).to(tl.int64)
        if tl.max(row, 0) >= 0:
            matrix_tap = all_taps - 1 - tap if REVERSE else tap
            for depth in range(0, DEPTHS):
                channel = depth * BLOCK_IN + lane
                values = tl.load(
                    rows + row[:, None] * c_in + channel[None, :],
                    mask=(row[:, None] >= 0) & (channel[None, :] < c_in),
                    other=0.0,
                )
                matrix = tl.load(
                    weight + matrix_tap * stride_tap + channel[:, None] * stride_in + column[None, :] * stride_out,
                    mask=(channel[:, None] < c_in) & (column[None, :] < c_out),
                    other=0.0,
                )
                total = _add_product(values, matrix, total, PRECISION, UPCAST)
    if HAS_BIAS:
        total += tl.load(bias + column, mask=column < c_out, other=0.0).to(tl.float32)[None, :]
    if HAS_RESIDUAL:
        total += tl.load(
            residual + target[:, None] * c_out + column[None, :],
            mask=(place[:, None] < num) & (column[None, :] < c_out),
            other=0.0,
        ).to(tl.float32)
    if RELU:
        total = tl.where(total < 0.0, 0.0, total)  # NaN stays what it is
    tl.store(
        out + target[:, None] * c_out + column[None, :],
        total.to(out.dtype.element_ty),
        mask=(place[:, None] < num) & (column[None, :] < c_out),
    )


def _weight_gradient(
    features: Tensor,  # [M_in, Cin]
    grad: Tensor,  # [M_out, Cout]
    kernel_map: KernelMap,
) -> Tensor:  # [K, Cin, Cout]
    """A partial sum per span of a tap's rows, then the sum of its spans in their order: the same on every run."""
    c_in, c_out, (taps, num) = features.shape[1], grad.shape[1], kernel_map.table.shape
    spans = max(1, min(triton.cdiv(num, LEAST_SPAN), triton.cdiv(SPANS, taps)))
    partial = features.new_empty(taps, spans, c_in, c_out, dtype=torch.float32)
    if partial.numel() > 0:
        tile_in, tile_out = _tile(c_in, MOST_SQUARE), _tile(c_out, MOST_SQUARE)
        with torch.cuda.device_of(features):
            _span_product[(taps * spans, triton.cdiv(c_in, tile_in), triton.cdiv(c_out, tile_out))](
                features,
                grad,
                partial,
                *(kernel_map.table, num, spans, triton.cdiv(num, spans)),
                *(c_in, c_out),
                PRECISION=_precision(),
                UPCAST=_upcast(features),
                BLOCK_ROWS=PAIRS if features.dtype != torch.float32 else PAIRS // 2,
                BLOCK_IN=tile_in,
                BLOCK_OUT=tile_out,
                num_warps=4,
                num_stages=3,
                enable_fp_fusion=True,
            )
    return partial.sum(1).to(features.dtype)


@triton.jit(do_not_specialize=["num", "spans", "length"])
def _span_product(  # noqa: ANN202
    features, grad, partial, table, num, spans, length, c_in, c_out,  # noqa: ANN001
    PRECISION: tl.constexpr, UPCAST: tl.constexpr,
    BLOCK_ROWS: tl.constexpr, BLOCK_IN: tl.constexpr, BLOCK_OUT: tl.constexpr,
):  # fmt: skip
    """Sum of x_i^T dy_o over the rows o of one span that see some i through its tap, a tile of its channels."""
    span = tl.program_id(0).to(tl.int64)
    channel = tl.program_id(1) * BLOCK_IN + tl.arange(0, BLOCK_IN)
    column = tl.program_id(2) * BLOCK_OUT + tl.arange(0, BLOCK_OUT)
    lane = tl.arange(0, BLOCK_ROWS)
    begin = (span % spans) * length
    last = tl.minimum(begin + length, num)
    total = tl.zeros((BLOCK_IN, BLOCK_OUT), tl.float32)
    for first in range(begin, last, BLOCK_ROWS):
        o = first + lane
        i = tl.load(table + span // spans * num + o, mask=o < last, other=-1).to(tl.int64)
        if tl.max(i, 0) >= 0:
            left = tl.load(
                features + i[:, None] * c_in + channel[None, :],
                mask=(i[:, None] >= 0) & (channel[None, :] < c_in),
                other=0.0,
            )
            right = tl.load(
                grad + o[:, None] * c_out + column[None, :],
                mask=(i[:, None] >= 0) & (column[None, :] < c_out),
                other=0.0,
            )
            total = _add_product(tl.trans(left), right, total, PRECISION, UPCAST)
    tl.store(
        partial + (span * c_in + channel[:, None]) * c_out + column[None, :],
        total,
        mask=(channel[:, None] < c_in) & (column[None, :] < c_out),
    )


def _tile(channels: int, most: int) -> int:
    """Edge of a tile over channels: the power of two that covers them, within what a product takes and memory holds."""
    return min(max(triton.next_power_of_2(channels), LEAST_TILE), most)


def _upcast(rows: Tensor) -> bool:
    """Whether products need float32 operands: the interpreter multiplies the bits of bfloat16 as integers."""
    return rows.dtype == torch.bfloat16 and interpreted()


def _precision() -> str:
    """Precision of float32 products: that of torch's convolutions, TF32 unless it is switched off."""
    return "tf32" if torch.backends.cudnn.conv.fp32_precision == "tf32" else "ieee"
