"""Tables of neighbours: which of a set of sites lies under each kernel tap of every cell, without waiting for a GPU."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from src.geometry.constants import arange, where_scalar
from src.ops.backend import implementation
from src.ops.moved_keys import Axis, moved_keys_reference

ORDERING_TAPS = 62
"""Taps that take part in the order of the rows: more bits fit no int64, and the order never changes a result."""


def neighbour_table(
    keys: Tensor,  # [n] int64, sorted, unique
    corners: Tensor,  # [m] int64, the key under a kernel's first tap
    taps: Tensor,  # [K] int64, what each tap adds to it
) -> tuple[Tensor, Tensor]:  # [K, m] int32, [m] int64
    """Row of the site under each tap, -1 where there is none, and the taps that meet one as bits of a number."""
    return implementation(neighbour_table_reference)(keys, corners, taps)


def neighbour_table_reference(keys: Tensor, corners: Tensor, taps: Tensor) -> tuple[Tensor, Tensor]:
    """A binary search for every tap and cell."""
    wanted = corners + taps[:, None]
    if len(keys) == 0:
        table = torch.full_like(wanted, -1, dtype=torch.int32)
    else:
        rows = torch.searchsorted(keys, wanted, out_int32=True).clamp_(max=len(keys) - 1)
        table = where_scalar(keys.index_select(0, rows.flatten()).view_as(wanted) == wanted, rows, -1)
    return table, tap_bits(table)


def stacked_table(
    table: Tensor,  # [K, m] int32 of rows below `m`, -1 for none
    places: tuple[Tensor, Tensor],  # [m] integer each, what row of either part each of these rows is, -1 for none
    first: int,  # rows of the first part, behind which those of the second stand
) -> tuple[Tensor, Tensor]:  # [2 K, m] int32, [m] int64
    """The table with the rows of either part in turn, and its tap bits."""
    return implementation(stacked_table_reference)(table, places, first)


def stacked_table_reference(table: Tensor, places: tuple[Tensor, Tensor], first: int) -> tuple[Tensor, Tensor]:
    """Plain torch form."""
    tables = []
    for place, before in zip(places, (0, first), strict=True):
        # One more, which is the place of none.
        shifted = F.pad(where_scalar(place >= 0, place + before, -1).to(table.dtype), (0, 1), value=-1)
        tables.append(shifted[table.long()])
    joined = torch.cat(tables)
    return joined, tap_bits(joined)


def tap_bits(
    table: Tensor,  # [K, m] int32, -1 for none
) -> Tensor:  # [m] int64
    """The taps of the table that meet a site as bits of a number, of the first ORDERING_TAPS."""
    shifts = arange(min(len(table), ORDERING_TAPS), torch.int64, table.device)[:, None]
    return ((table[:ORDERING_TAPS] >= 0).long() << shifts).sum(0)


def moved_table(
    keys: Tensor,  # [n] int64, sorted, unique
    cells: Tensor,  # [m] int64, keys on another grid
    samples: tuple[int, int],
    axes: tuple[Axis, ...],
    shift: tuple[int, ...],
    taps: Tensor,  # [K] int64
) -> tuple[Tensor, Tensor]:  # [K, m] int32, [m] int64
    """`neighbour_table` of the corners that `moved_keys` makes of the cells with one shift."""
    return implementation(moved_table_reference)(keys, cells, samples, axes, shift, taps)


def moved_table_reference(
    keys: Tensor, cells: Tensor, samples: tuple[int, int], axes: tuple[Axis, ...], shift: tuple[int, ...], taps: Tensor
) -> tuple[Tensor, Tensor]:
    """Plain torch form."""
    return neighbour_table_reference(keys, moved_keys_reference(cells, samples, axes, (shift,))[0], taps)


def transposed_table(
    table: Tensor,  # [K, m] int32 of rows below `num`, none twice in a row of the table, -1 for none
    num: int,
) -> tuple[Tensor, Tensor]:  # [K, num] int32, [num] int64
    """The table read backwards: the cell that sees each site through each tap, -1 where there is none; its tap bits."""
    return implementation(transposed_table_reference)(table, num)


def transposed_table_reference(table: Tensor, num: int) -> tuple[Tensor, Tensor]:
    """Plain torch form."""
    back = table.new_full((len(table), num + 1), -1)  # one more column, which takes what there is not
    cells = arange(table.shape[1], table.dtype, table.device).expand_as(table)
    back.scatter_(1, torch.where(table < 0, num, table).long(), cells)
    back = back[:, :num].contiguous()
    return back, tap_bits(back)


def pairs_of_table(
    table: Tensor,  # [K, m] int32, -1 for none
) -> tuple[Tensor, Tensor, tuple[int, ...]]:  # [pairs] int32, [pairs] int32
    """Inputs, outputs and counts of a `KernelMap`. Waits for a GPU."""
    counts = tuple((table >= 0).sum(1).tolist())
    hits = torch.nonzero_static((table >= 0).flatten(), size=sum(counts)).squeeze(1)
    outputs = torch.remainder(hits, max(table.shape[1], 1)).to(torch.int32)
    return table.flatten().index_select(0, hits), outputs, counts


def table_of_pairs(
    counts: tuple[int, ...],  # pairs of each tap
    seeing: Tensor,  # [pairs] int32, rows among `num`, tap after tap
    seen: Tensor,  # [pairs] int32, rows of the other side
    num: int,
) -> Tensor:  # [K, num] int32
    """The row that each row sees through each tap, -1 where there is none."""
    table = seen.new_full((len(counts), num), -1)
    for row, own, other in zip(table, seeing.split(counts), seen.split(counts), strict=True):
        row[own.long()] = other
    return table
