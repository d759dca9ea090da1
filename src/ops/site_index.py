"""Looking up cells among sites: a bit for every cell of the rows that hold sites, in place of binary searches."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from src.geometry.constants import arange, constant
from src.ops.sites import HALO, Sites

SHIFT = 4
CHUNK = 1 << SHIFT
"""Cells along the last axis from one word to the next. A word has bits for twice as many, so it holds any run of at
most CHUNK cells that begins in its first half."""


@dataclass(frozen=True, eq=False)
class SiteIndex:
    """Sites by rows, lines of cells along the last axis; only rows that hold a site have words.

    On a CPU faster than binary searches where sites share rows, as voxels of a scene do (`suite=ops`: kernel map).
    Memory: 8 bytes a row of the grid, and for every CHUNK cells of a row with sites.
    """

    begins: Tensor  # [rows of the grid, with a margin] int64, first word of each row, 0 for one without sites
    words: Tensor  # [words of an empty row, then of all with sites] int32
    first: Tensor  # [as words] int32, number of sites before the word; arbitrary where the word is 0
    stride: int  # step of the key from row to row
    margin: int  # rows before the grid

    @classmethod
    def of(cls, sites: Sites) -> SiteIndex:
        """The index of the sites, cached on them."""
        if "site_index" not in sites.cache:
            sites.cache["site_index"] = cls._build(sites)
        return sites.cache["site_index"]

    @classmethod
    def _build(cls, sites: Sites) -> SiteIndex:
        keys, stride, num = sites.keys, sites.strides[-2], len(sites)
        steps = sum(step // stride for step in sites.strides[1:-1])
        margin, tail = HALO * steps, CHUNK * steps  # windows may reach so far, those of padding behind the grid
        width = -(-(stride + HALO) // CHUNK) + 2  # a chunk before the cells, as words reach into the one behind them
        row = torch.div(keys, stride, rounding_mode="floor")
        place = keys - row * stride + (HALO + CHUNK)
        begin = _changes(row).cumsum(0).mul_(width)
        begins = keys.new_zeros(margin + sites.end // stride + tail + 1)
        begins.index_copy_(0, row + margin, begin)
        at = begin + (place >> SHIFT)
        bits = _bit(place & (CHUNK - 1)).mul_(_changes(keys))  # padding repeats a key
        words = bits.new_zeros((int(begin[-1]) if num else 0) + width)
        words.index_add_(0, at, bits).index_add_(0, at - 1, bits << CHUNK)
        starts = _changes(at).nonzero().squeeze(1)
        chunks, before = at.index_select(0, starts), starts.to(torch.int32)
        first = torch.empty_like(words).index_copy_(0, chunks - 1, before).index_copy_(0, chunks, before)
        return cls(begins, words, first, stride, margin)

    def windows(
        self,
        corners: Tensor,  # [m] int64, keys of cells
        rows: Tensor,  # [L] int64, rows from there; no window begins more than HALO outside the grid
        taps: int,  # at most CHUNK
    ) -> Windows:
        """The `taps` cells from each corner on in each of the rows. Raises ValueError for too many of them."""
        if taps > CHUNK:
            raise ValueError(f"{taps} cells in a row: a look-up tells of {CHUNK} at most; use a smaller kernel")
        from_row = corners + HALO
        row = torch.div(from_row, self.stride, rounding_mode="floor")
        place = from_row - row * self.stride + CHUNK
        lines = (row + self.margin) + rows[:, None]
        at = self.begins.index_select(0, lines.flatten()).view_as(lines).add_(place >> SHIFT)
        words = self.words.index_select(0, at.flatten()).view_as(at)
        return Windows(at, words, (place & (CHUNK - 1)).to(torch.int32), taps, self.first)


@dataclass(frozen=True, eq=False)
class Windows:
    """Runs of cells: which of them are sites, and which sites those are."""

    at: Tensor  # [L, m] int64, where the word of each run stands
    words: Tensor  # [L, m] int32
    start: Tensor  # [m] int32, bit of the first cell
    taps: int
    first: Tensor  # of the index

    def found(self) -> Tensor:  # [L * taps, m] bool
        """Whether each cell is a site."""
        taps = arange(self.taps, torch.int32, self.words.device)[:, None]
        return ((self.words >> self.start)[:, None] >> taps).bitwise_and_(1).bool().flatten(0, 1)

    def sites(
        self,
        taps: Tensor,  # [hits] int64, rows of `found` ...
        columns: Tensor,  # [hits] int64, ... and its columns, where it is true
    ) -> Tensor:  # [hits] int32
        """Row of each site that was found."""
        line = torch.div(taps, self.taps, rounding_mode="floor")
        where = line * self.words.shape[1] + columns
        bit = self.start.index_select(0, columns) + (taps - line * self.taps).to(torch.int32)
        before = self.words.flatten().index_select(0, where) & (_bit(bit) - 1)
        return self.first.index_select(0, self.at.flatten().index_select(0, where)) + _count_bits(before)


def _changes(values: Tensor) -> Tensor:  # [n] bool
    """Where a value differs from the one before."""
    changes = torch.ones_like(values, dtype=torch.bool)
    torch.ne(values[1:], values[:-1], out=changes[1:])
    return changes


def _bit(places: Tensor) -> Tensor:  # int32
    """2 to the power of each place [n]."""
    return constant((1,), torch.int32, places.device) << places.to(torch.int32)


def _count_bits(words: Tensor) -> Tensor:
    """Number of ones in each word [n] int32, none negative."""
    pairs = words - ((words >> 1) & 0x55555555)
    fours = (pairs & 0x33333333) + ((pairs >> 2) & 0x33333333)
    return (((fours + (fours >> 4)) & 0x0F0F0F0F) * 0x01010101) >> 24
