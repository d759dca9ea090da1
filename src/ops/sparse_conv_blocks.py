"""Sparse convolution in few large products of gathered rows, for libraries that make a program for every shape."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor

from src.ops.kernel_map import KernelMap
from src.ops.products import MOST_ROWS, ROW_STEP, matmul, row_spans, row_steps
from src.ops.scratch import scratch
from src.ops.sparse_conv_function import SparseConvFunction

GATHERED_BYTES = 5 << 19
"""Bytes of the rows gathered for one product. Measured: a quarter or four times as much costs 5 to 15 %."""
LEAST_FILL = 0.47
"""Share of a block's pairs that exist, below which blocks of fewer offsets are better, whose rows are fewer."""
SMALL = 1 << 15
"""(row, offset) pairs below which the number of blocks counts, not what they multiply."""


@dataclass(frozen=True, eq=False)
class Block:
    """Some neighbouring kernel offsets, and which row each row gathers through each of them.

    An index that equals the number of gathered rows stands for a row of zeros; rows are filled up with it to a multiple
    of ROW_STEP.
    """

    offsets: slice
    table: Tensor  # [r up to a step, T] int32, rows that are gathered
    rows: Tensor | None  # [r] int64, rows that the results are added to; None: all, as they come


def blocked_sparse_conv(
    features: Tensor,  # [M_in, Cin]
    weight: Tensor,  # [K, Cin, Cout]
    kernel_map: KernelMap,
    bias: Tensor | None,  # [Cout]
    dtype: torch.dtype,  # of the operands of products
) -> Tensor:  # [M_out, Cout]
    """`sparse_conv` as gather and product over several offsets at once, zeros standing for pairs that do not exist.

    Products are summed in float32 at least.
    """
    forward, gradients = partial(_forward, dtype=dtype), partial(_gradients, dtype=dtype)
    return SparseConvFunction.apply(features, weight, bias, kernel_map, forward, gradients)


def _forward(features: Tensor, weight: Tensor, bias: Tensor | None, maps: KernelMap, dtype: torch.dtype) -> Tensor:
    out, _ = _convolve(features, weight, blocks(maps), maps.num_outputs, dtype)
    return (out if bias is None else out.add_(bias)).to(features.dtype)


def _gradients(
    features: Tensor, weight: Tensor, grad: Tensor, maps: KernelMap, needed: list[bool], dtype: torch.dtype
) -> tuple[Tensor, Tensor | None]:
    # A mirrored map is its own transpose once the offsets are reversed.
    turned = (weight.flip(0) if maps.mirrored else weight).transpose(1, 2)
    others = features if needed[1] else None
    out, grad_weight = _convolve(grad, turned, blocks(maps, not maps.mirrored), maps.num_inputs, dtype, others)
    if grad_weight is not None:
        grad_weight = (grad_weight.flip(0) if maps.mirrored else grad_weight).to(weight.dtype)
    return out.to(features.dtype), grad_weight


def _convolve(
    rows: Tensor,  # [n, Ca] features, or backward the gradient of the output
    weight: Tensor,  # [K, Ca, Cb]
    parts: tuple[Block, ...],
    num: int,
    dtype: torch.dtype,  # of the operands
    others: Tensor | None = None,  # [num, Cb] the features, if backward is to make the gradient of the weight
) -> tuple[Tensor, Tensor | None]:  # [num, Cb], [K, Cb, Ca]
    """The convolution, or both its gradients: backward, the same gathered rows serve the features and the weight."""
    full = torch.promote_types(dtype, torch.float32)
    c_in, c_out = weight.shape[1:]
    rows, weight = _padded("rows", rows, dtype), weight.to(dtype)
    out = rows.new_zeros(row_steps(num), c_out, dtype=full)
    grad = None
    if others is not None:
        others, grad = _padded("others", others, dtype), rows.new_zeros(len(weight), c_out, c_in, dtype=full)
    for part in parts:
        matrix = weight[part.offsets].reshape(-1, c_out)  # [T * Ca, Cb]
        for span in _spans(len(part.table), len(matrix), dtype):
            gathered = _gather("gathered", rows, part.table[span]).view(-1, len(matrix))
            product = matmul(gathered, matrix)
            if part.rows is None:
                out[span] += product
            else:
                into = part.rows[span]  # distinct, so the order of the additions does not matter
                out.index_add_(0, into, product[: len(into)].to(full))
            if grad is not None:
                if part.rows is None:
                    partners = others[span]
                else:
                    partners = _gather("partners", others, _filled(into, len(gathered), num))
                products = matmul(partners.t(), gathered).view(c_out, -1, c_in)  # [Cb, T, Ca]
                grad[part.offsets] += products.transpose(0, 1)
    return out[:num], grad


def blocks(kernel_map: KernelMap, backward: bool = False) -> tuple[Block, ...]:
    """The map from its outputs' side, or backward from its inputs'; cached on it."""
    key = ("blocks", backward)
    if key not in kernel_map.cache:
        kernel_map.cache[key] = _build(kernel_map, backward)
    return kernel_map.cache[key]


def _build(kernel_map: KernelMap, backward: bool) -> tuple[Block, ...]:
    sources, targets = kernel_map.inputs, kernel_map.outputs
    nothing, num = kernel_map.num_inputs, kernel_map.num_outputs
    if backward:
        sources, targets, nothing, num = targets, sources, num, nothing
    counts = torch.tensor(kernel_map.counts, device=sources.device)
    offsets, targets = torch.repeat_interleave(counts, output_size=len(sources)), targets.long()
    for size in _divisors(kernel_map.num_offsets):
        row = torch.div(offsets, size, rounding_mode="floor") * num + targets
        seen = row.new_zeros(kernel_map.num_offsets // size * num, dtype=torch.bool).index_fill_(0, row, True)
        held = size * int(seen.sum())
        if held <= SMALL or len(sources) >= LEAST_FILL * held:
            break
    place = seen.cumsum(0)  # 1, 2, 3, ... over the rows of all blocks
    parts, start, before = [], 0, 0
    for first, of_block in zip(range(0, kernel_map.num_offsets, size), seen.split(num), strict=True):
        pairs = slice(start, start := start + sum(kernel_map.counts[first : first + size]))
        rows = of_block.nonzero().squeeze(1)
        if len(rows):
            table = sources.new_full((row_steps(len(rows)), size), nothing)
            at = (place[row[pairs]] - 1 - before) * size + offsets[pairs] - first
            table.view(-1)[at] = sources[pairs]
            parts.append(Block(slice(first, first + size), table, None if len(rows) == num else rows))
            before += len(rows)
    return tuple(parts)


def _divisors(number: int) -> list[int]:
    """Descending, without 1 where there is another."""
    return [size for size in range(number, min(number, 2) - 1, -1) if number % size == 0]


def _filled(rows: Tensor, count: int, value: int) -> Tensor:
    """The rows, filled up to a count of them with a value."""
    return F.pad(rows, (0, 0) * (rows.dim() - 1) + (0, count - len(rows)), value=value)


def _padded(name: str, rows: Tensor, dtype: torch.dtype) -> Tensor:
    """The rows in a type, with rows of zeros behind them: at least one, and up to a step."""
    block = scratch(name, row_steps(len(rows) + 1), rows.shape[1], dtype, rows.device)
    block[: len(rows)] = rows
    block[len(rows) :] = 0
    return block


def _gather(name: str, rows: Tensor, picks: Tensor) -> Tensor:
    picks = picks.reshape(-1)
    block = scratch(name, len(picks), rows.shape[1], rows.dtype, rows.device)
    return torch.index_select(rows, 0, picks, out=block)


def _spans(rows: int, width: int, dtype: torch.dtype) -> Iterator[slice]:
    """Slices of rows [rows, width] for one product each."""
    step = GATHERED_BYTES // (width * dtype.itemsize) // ROW_STEP * ROW_STEP
    return row_spans(rows, min(max(step, ROW_STEP), MOST_ROWS))
