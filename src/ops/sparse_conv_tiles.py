"""Sparse convolution in tiles of output rows that fit the cache, without products of zeros."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from src.ops.kernel_map import KernelMap
from src.ops.scratch import scratch
from src.ops.segment_reduce import gather_segment_sum
from src.ops.sparse_conv_function import SparseConvFunction

TILE_BYTES = 16 << 20
"""Bytes gathered and multiplied for one tile. Measured: a quarter or four times as much costs 5 to 25 %."""
LEAST_ROWS = 256


@dataclass(frozen=True, eq=False)
class Tile:
    """Pairs whose results go to the rows `first` to `last` of the output, one kernel offset after the other."""

    first: int
    last: int
    gathered: Tensor  # [pairs] int32, rows that are read
    summed: Tensor  # [pairs] int32, rows that the results are added to
    spans: tuple[tuple[int, int, int], ...]  # (kernel offset, first pair, last pair), without empty ones
    order: Tensor  # [pairs] int32, the pairs by summed row
    starts: Tensor  # [last - first + 1] int32, first place of each row in `order`


@dataclass(frozen=True, eq=False)
class TiledRulebook:
    """All pairs of a kernel map, except its centre's where it has one, tile by tile."""

    tiles: tuple[Tile, ...]
    most_pairs: int  # of any tile


def tiled_sparse_conv(
    features: Tensor,  # [M_in, Cin]
    weight: Tensor,  # [K, Cin, Cout]
    kernel_map: KernelMap,
    bias: Tensor | None,  # [Cout]
) -> Tensor:  # [M_out, Cout]
    """`sparse_conv` as gather, one product per offset and segment sum within each tile of the rulebook."""
    return SparseConvFunction.apply(features, weight, bias, kernel_map, _forward, _gradients)


def _forward(features: Tensor, weight: Tensor, bias: Tensor | None, kernel_map: KernelMap) -> Tensor:
    out, _ = _convolve(features, weight, kernel_map, backward=False)
    return out if bias is None else out.add_(bias)


def _gradients(
    features: Tensor, weight: Tensor, grad: Tensor, kernel_map: KernelMap, needed: list[bool]
) -> tuple[Tensor, Tensor | None]:
    return _convolve(grad, weight, kernel_map, backward=True, others=features if needed[1] else None)


def _convolve(
    rows: Tensor,  # [n, Ca] features, or backward the gradient of the output
    weight: Tensor,  # [K, Cin, Cout]
    kernel_map: KernelMap,
    backward: bool,
    others: Tensor | None = None,  # [m, Cin] the features, if backward is to make the gradient of the weight
) -> tuple[Tensor, Tensor | None]:  # [m, Cb], [K, Cin, Cout]
    """The convolution, or both its gradients: backward, a tile's gathered rows serve the features and the weight."""
    num = kernel_map.num_inputs if backward else kernel_map.num_outputs
    matrices = (weight.transpose(1, 2) if backward else weight).unbind(0)
    width_in, width = matrices[0].shape
    grad_weight = None if others is None else torch.zeros_like(weight)
    gradients = () if grad_weight is None else grad_weight.unbind(0)
    centre = _centre(kernel_map)
    if centre is None:
        out = rows.new_empty(num, width)
    else:
        out = torch.mm(rows, matrices[centre])
        if others is not None:
            gradients[centre].add_(torch.mm(others.t(), rows))
    if backward and kernel_map.mirrored:  # the tiles are those of the forward pass
        matrices, gradients = matrices[::-1], gradients[::-1]
    rulebook = tiled_rulebook(kernel_map, backward, (width_in + width) * rows.itemsize)
    gathered_rows = scratch("gathered", rulebook.most_pairs, width_in, rows.dtype, rows.device)
    products = scratch("products", rulebook.most_pairs, width, rows.dtype, rows.device)
    for tile in rulebook.tiles:
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
                gradients[offset].addmm_(partners[first:last].t(), gathered[first:last])
    return out, grad_weight


def tiled_rulebook(
    kernel_map: KernelMap,
    backward: bool,
    bytes_per_pair: int,
) -> TiledRulebook:
    """The map's pairs in tiles of about TILE_BYTES; cached on the map.

    Forward, input rows are gathered and output rows summed; backward the reverse. A submanifold map is its own
    transpose with the offsets reversed: its tiles serve both passes. Its centre pairs every row with itself and is left
    out.
    """
    backward = backward and not kernel_map.mirrored
    num = kernel_map.num_inputs if backward else kernel_map.num_outputs
    pairs_per_row = max(1.0, len(kernel_map.inputs) / max(num, 1))
    rows = TILE_BYTES / (pairs_per_row * bytes_per_pair)
    rows = max(LEAST_ROWS, 2 ** round(math.log2(rows)))  # powers of two, so that layers of like width share tiles
    rows = num if rows >= num else rows
    key = ("tiles", backward, rows)
    if key not in kernel_map.cache:
        kernel_map.cache[key] = _build(kernel_map, backward, max(rows, 1), num)
    return kernel_map.cache[key]


def _build(kernel_map: KernelMap, backward: bool, rows: int, num: int) -> TiledRulebook:
    gathered, summed = kernel_map.inputs, kernel_map.outputs
    if backward:
        gathered, summed = summed, gathered
    # Both columns ascend within the block of an offset, so a tile's share of a block is a slice of it.
    device = summed.device
    edges = torch.arange(-(-num // rows) + 1, dtype=torch.int32, device=device).mul_(rows).clamp_(max=num)
    offsets, blocks, centre = [], [], _centre(kernel_map)
    for offset, (sources, targets) in enumerate(
        zip(gathered.split(kernel_map.counts), summed.split(kernel_map.counts), strict=True)
    ):
        if offset != centre and len(targets):
            offsets.append(offset)
            blocks.append((sources, targets, torch.searchsorted(targets, edges).tolist()))
    tiles = []
    for number, (first, last) in enumerate(itertools.pairwise(edges.tolist())):
        parts, spans, place = [], [], 0
        for offset, (sources, targets, cuts) in zip(offsets, blocks, strict=True):
            low, high = cuts[number], cuts[number + 1]
            if low < high:
                parts.append((sources[low:high], targets[low:high]))
                spans.append((offset, place, place := place + high - low))
        if parts:
            sources, targets = (torch.cat(column) for column in zip(*parts, strict=True))
        else:
            sources = targets = gathered[:0]
        by_row, order = torch.sort(targets, stable=True)  # a radix sort, as these are int32
        wanted = torch.arange(first, last + 1, dtype=torch.int32, device=device)
        starts = torch.searchsorted(by_row, wanted, out_int32=True)
        tiles.append(Tile(first, last, sources, targets, tuple(spans), order.to(torch.int32), starts))
    return TiledRulebook(tuple(tiles), max((len(tile.gathered) for tile in tiles), default=0))


def _centre(kernel_map: KernelMap) -> int | None:
    """The offset that joins every row with itself, None for a map that is not submanifold."""
    return kernel_map.num_offsets // 2 if kernel_map.mirrored else None
