"""Sparse convolution as implicit GEMM in Triton: rows are gathered straight into the product."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import torch
import torch.nn.functional as F
import triton
import triton.language as tl
from torch import Tensor

from src.geometry.constants import on_device
from src.ops.backend import interpreted, runs_kernels
from src.ops.kernel_maps import KernelMap
from src.ops.segment_reduce import gather_segment_sum
from src.ops.sparse_conv import sparse_conv_reference
from src.ops.sparse_conv_function import SparseConvFunction

DTYPES = (torch.float32, torch.float16, torch.bfloat16)
# Output rows a program computes, and pairs it multiplies at a time for the gradient of the weights.
ROWS = 64
PAIRS = 64
# Tile edges: powers of two from 16, the least a tensor core takes, to what three stages keep in shared memory.
LEAST_TILE = 16
MOST_OUT = 128
MOST_DEPTH = {torch.float32: 32, torch.float16: 64, torch.bfloat16: 64}
MOST_SQUARE = 64
# Pairs are cut into about this many spans, each with a partial gradient of the weights, but into none shorter than...
SPANS = 256
LEAST_SPAN = 512
# Taps that take part in the order of the rows; the order never changes a result, and more bits fit no int64.
ORDERING_TAPS = 62


@dataclass(frozen=True, eq=False)
class Neighbours:
    """The rulebook as a table: which row each row sees through each tap (kernel offset), in blocks of ROWS rows.

    Rows that see through the same taps stand together, so that a block has few taps to walk: on the maps of a radar
    backbone a product takes 1.0 to 1.9 rows a pair, where blocks of the rows as they come take 1.0 to 25.
    """

    order: Tensor  # [n] int64, rows in the order of the table
    table: Tensor  # [K, n up to a multiple of ROWS] int32, row of the other side, -1 where there is none
    taps: Tensor  # [blocks, K] int32, the taps through which a block sees anything come first, ascending
    num_taps: Tensor  # [blocks] int32, how many those are


def sparse_conv_triton(
    features: Tensor,  # [M_in, Cin]
    weight: Tensor,  # [K, Cin, Cout]
    kernel_map: KernelMap,
    bias: Tensor | None,  # [Cout]
) -> Tensor:  # [M_out, Cout]
    """The reference's sums in float32, in one launch forward and two or three backward; a linear layer stays one."""
    if kernel_map.identity or features.dtype not in DTYPES or not runs_kernels(features):
        return sparse_conv_reference(features, weight, kernel_map, bias)
    return SparseConvFunction.apply(features.contiguous(), weight, bias, kernel_map, _forward, _gradients)


def _forward(features: Tensor, weight: Tensor, bias: Tensor | None, kernel_map: KernelMap) -> Tensor:
    return _product(features, weight, _neighbours(kernel_map, backward=False), bias)


def _gradients(
    features: Tensor, weight: Tensor, grad: Tensor, maps: KernelMap, needed: list[bool]
) -> tuple[Tensor | None, Tensor | None]:
    grad_features = None
    if needed[0]:
        # A mirrored map is its own transpose once the taps are reversed.
        turned = (weight.flip(0) if maps.mirrored else weight).transpose(1, 2)
        grad_features = _product(grad, turned, _neighbours(maps, backward=not maps.mirrored), None)
    return grad_features, _weight_gradient(features, grad, maps) if needed[1] else None


def _product(
    rows: Tensor,  # [m, Ca]
    weight: Tensor,  # [K, Ca, Cb], any strides
    neighbours: Neighbours,  # of n rows among m
    bias: Tensor | None,  # [Cb]
) -> Tensor:  # [n, Cb]
    num, (_, c_in, c_out) = len(neighbours.order), weight.shape
    out = rows.new_empty(num, c_out)
    if out.numel() == 0:
        return out
    depth, width = _tile(c_in, MOST_DEPTH[rows.dtype]), _tile(c_out, MOST_OUT)
    with torch.cuda.device_of(rows):
        _gather_product[(len(neighbours.num_taps), triton.cdiv(c_out, width))](
            rows,
            weight,
            out if bias is None else bias.contiguous(),
            out,
            *(neighbours.order, neighbours.table, neighbours.taps, neighbours.num_taps),
            *(num, neighbours.table.shape[1], len(weight), c_in, c_out, *weight.stride()),
            HAS_BIAS=bias is not None,
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


@triton.jit
def _gather_product(  # noqa: ANN202
    rows, weight, bias, out, order, table, taps, num_taps,  # noqa: ANN001
    num, padded, all_taps, c_in, c_out, stride_tap, stride_in, stride_out,  # noqa: ANN001
    HAS_BIAS: tl.constexpr, PRECISION: tl.constexpr, UPCAST: tl.constexpr, DEPTHS: tl.constexpr,
    BLOCK_ROWS: tl.constexpr, BLOCK_IN: tl.constexpr, BLOCK_OUT: tl.constexpr,
):  # fmt: skip
    """One block of output rows and channels: walks the block's taps and, within each, the input channels."""
    block = tl.program_id(0)
    place = block * BLOCK_ROWS + tl.arange(0, BLOCK_ROWS)
    column = tl.program_id(1) * BLOCK_OUT + tl.arange(0, BLOCK_OUT)
    lane = tl.arange(0, BLOCK_IN)
    total = tl.zeros((BLOCK_ROWS, BLOCK_OUT), tl.float32)
    for step in range(0, tl.load(num_taps + block) * DEPTHS):
        tap = tl.load(taps + block * all_taps + step // DEPTHS)
        channel = step % DEPTHS * BLOCK_IN + lane
        row = tl.load(table + tap * padded + place).to(tl.int64)
        values = tl.load(
            rows + row[:, None] * c_in + channel[None, :],
            mask=(row[:, None] >= 0) & (channel[None, :] < c_in),
            other=0.0,
        )
        matrix = tl.load(
            weight + tap * stride_tap + channel[:, None] * stride_in + column[None, :] * stride_out,
            mask=(channel[:, None] < c_in) & (column[None, :] < c_out),
            other=0.0,
        )
        total = _add_product(values, matrix, total, PRECISION, UPCAST)
    if HAS_BIAS:
        total += tl.load(bias + column, mask=column < c_out, other=0.0).to(tl.float32)[None, :]
    target = tl.load(order + place, mask=place < num, other=0)
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
    """A partial sum per span of pairs, then the sum of each tap's spans in their order: the same on every run."""
    c_in, c_out = features.shape[1], grad.shape[1]
    bounds, spans, first_span = _spans(kernel_map)
    partial = features.new_empty(len(bounds), c_in, c_out, dtype=torch.float32)
    if partial.numel() > 0:
        tile_in, tile_out = _tile(c_in, MOST_SQUARE), _tile(c_out, MOST_SQUARE)
        with torch.cuda.device_of(features):
            _span_product[(len(bounds), triton.cdiv(c_in, tile_in), triton.cdiv(c_out, tile_out))](
                features,
                grad,
                partial,
                *(kernel_map.inputs, kernel_map.outputs, bounds),
                *(c_in, c_out),
                PRECISION=_precision(),
                UPCAST=_upcast(features),
                BLOCK_PAIRS=PAIRS if features.dtype != torch.float32 else PAIRS // 2,
                BLOCK_IN=tile_in,
                BLOCK_OUT=tile_out,
                num_warps=4,
                num_stages=3,
                enable_fp_fusion=True,
            )
    return gather_segment_sum(partial.flatten(1), spans, first_span).view(-1, c_in, c_out).to(features.dtype)


@triton.jit
def _span_product(  # noqa: ANN202
    features, grad, partial, inputs, outputs, bounds, c_in, c_out,  # noqa: ANN001
    PRECISION: tl.constexpr, UPCAST: tl.constexpr,
    BLOCK_PAIRS: tl.constexpr, BLOCK_IN: tl.constexpr, BLOCK_OUT: tl.constexpr,
):  # fmt: skip
    """Sum of x_i^T dy_o over the pairs (i, o) of one span, a tile of its channels."""
    span = tl.program_id(0).to(tl.int64)
    channel = tl.program_id(1) * BLOCK_IN + tl.arange(0, BLOCK_IN)
    column = tl.program_id(2) * BLOCK_OUT + tl.arange(0, BLOCK_OUT)
    lane = tl.arange(0, BLOCK_PAIRS)
    last = tl.load(bounds + span * 2 + 1)
    total = tl.zeros((BLOCK_IN, BLOCK_OUT), tl.float32)
    for first in range(tl.load(bounds + span * 2), last, BLOCK_PAIRS):
        live = first + lane < last
        i = tl.load(inputs + first + lane, mask=live, other=0).to(tl.int64)
        o = tl.load(outputs + first + lane, mask=live, other=0).to(tl.int64)
        left = tl.load(
            features + i[:, None] * c_in + channel[None, :],
            mask=live[:, None] & (channel[None, :] < c_in),
            other=0.0,
        )
        right = tl.load(
            grad + o[:, None] * c_out + column[None, :],
            mask=live[:, None] & (column[None, :] < c_out),
            other=0.0,
        )
        total = _add_product(tl.trans(left), right, total, PRECISION, UPCAST)
    tl.store(
        partial + (span * c_in + channel[:, None]) * c_out + column[None, :],
        total,
        mask=(channel[:, None] < c_in) & (column[None, :] < c_out),
    )


def _neighbours(kernel_map: KernelMap, backward: bool) -> Neighbours:
    """The map's tables, forward or backward, made without synchronising with the device; cached on the map."""
    key = ("neighbours", backward)
    if key not in kernel_map.cache:
        sides = (kernel_map.outputs, kernel_map.num_outputs), (kernel_map.inputs, kernel_map.num_inputs)
        (seeing, num), (seen, _) = reversed(sides) if backward else sides
        kernel_map.cache[key] = _arrange(_table(kernel_map.counts, seeing, seen, num))
    return kernel_map.cache[key]


def _table(
    counts: tuple[int, ...],  # pairs of each tap
    seeing: Tensor,  # [pairs] int32, rows among `num`, tap after tap
    seen: Tensor,  # [pairs] int32, rows of the other side
    num: int,
) -> Tensor:  # [K, num] int32
    """The row that each row sees through each tap, -1 where there is none."""
    ends = on_device(list(itertools.accumulate(counts)), torch.int32, seeing.device)
    pair = torch.arange(len(seeing), dtype=torch.int32, device=seeing.device)
    tap = torch.searchsorted(ends, pair, right=True)  # [pairs] int64
    table = seen.new_full((len(counts), num), -1)
    table.view(-1).scatter_(0, tap * num + seeing, seen)
    return table


def _arrange(
    table: Tensor,  # [K, n] int32
) -> Neighbours:
    taps = torch.arange(len(table), device=table.device)[:ORDERING_TAPS, None]
    bits = ((table[:ORDERING_TAPS] >= 0).long() << taps).sum(0)  # [n]
    order = torch.argsort(bits, stable=True)
    table = F.pad(table.index_select(1, order), (0, -len(order) % ROWS), value=-1)
    sees = (table.view(len(table), -1, ROWS) >= 0).any(2).t().contiguous().to(torch.int32)  # [blocks, K]
    taps_first = torch.argsort(sees, dim=1, descending=True, stable=True)
    return Neighbours(order, table, taps_first.to(torch.int32), sees.sum(1, dtype=torch.int32))


def _spans(kernel_map: KernelMap) -> tuple[Tensor, Tensor, Tensor]:  # [spans, 2], [spans], [K + 1], all int32
    """First and last pair of each span, none across two taps; 0, 1, ...; first span of each tap; cached on the map."""
    if "spans" not in kernel_map.cache:
        length = max(LEAST_SPAN, -(-len(kernel_map.inputs) // SPANS))
        bounds, first_span, begin = [], [0], 0
        for count in kernel_map.counts:
            end = begin + count
            bounds += [(first, min(first + length, end)) for first in range(begin, end, length)]
            first_span.append(len(bounds))
            begin = end
        numbers = [*itertools.chain(*bounds), *range(len(bounds)), *first_span]
        sizes = (2 * len(bounds), len(bounds), len(first_span))
        flat, spans, starts = on_device(numbers, torch.int32, kernel_map.inputs.device).split(sizes)
        kernel_map.cache["spans"] = flat.view(-1, 2), spans, starts
    return kernel_map.cache["spans"]


def _tile(channels: int, most: int) -> int:
    """Edge of a tile over channels: the power of two that covers them, within what a product takes and memory holds."""
    return min(max(triton.next_power_of_2(channels), LEAST_TILE), most)


def _upcast(rows: Tensor) -> bool:
    """Whether products need float32 operands: the interpreter multiplies the bits of bfloat16 as integers."""
    return rows.dtype == torch.bfloat16 and interpreted()


def _precision() -> str:
    """Precision of float32 products, as set by `torch.set_float32_matmul_precision`."""
    return "ieee" if torch.get_float32_matmul_precision() == "highest" else "tf32"
