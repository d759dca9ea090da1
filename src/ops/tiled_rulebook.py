"""Tiled rulebook: a kernel map's pairs in tiles of output rows that fit the cache, for sparse convolution on a CPU."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from src.ops.kernel_maps import KernelMap

TILE_BYTES = 16 << 20
"""Bytes gathered and multiplied for one tile. Measured: a quarter or four times as much costs 5 to 25 %."""
HALF_TILE_BYTES = 64 << 20
"""The same in half precision, where each new matrix shape has a set-up cost: fewer, larger tiles."""
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


def tiled_rulebook(
    kernel_map: KernelMap,
    backward: bool,
    values_per_pair: int,
    dtype: torch.dtype,
) -> TiledRulebook:
    """The map's pairs in tiles of about TILE_BYTES of these values; cached on the map.

    Forward, input rows are gathered and output rows summed; backward the reverse. A submanifold map is its own
    transpose with the offsets reversed: its tiles serve both passes. Its centre pairs every row with itself and is left
    out.
    """
    backward = backward and not kernel_map.mirrored
    num = kernel_map.num_inputs if backward else kernel_map.num_outputs
    pairs_per_row = max(1.0, len(kernel_map.inputs) / max(num, 1))
    budget = TILE_BYTES if dtype.itemsize >= 4 else HALF_TILE_BYTES
    rows = budget / (pairs_per_row * values_per_pair * dtype.itemsize)
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
    offsets, blocks = [], []
    for offset, (sources, targets) in enumerate(
        zip(gathered.split(kernel_map.counts), summed.split(kernel_map.counts), strict=True)
    ):
        if offset != kernel_map.centre and len(targets):
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
