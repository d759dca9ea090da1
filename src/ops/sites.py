"""Sets of active cells: sorted integer keys with shifts, look-ups and unions, without a dense grid."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from src.geometry.constants import arange, constant, where_scalar
from src.ops.distinct_keys import Groups
from src.ops.fixed_shapes import fixed_shapes
from src.ops.moved_keys import moved_keys
from src.ops.neighbour_table import neighbour_table

# Empty cells kept behind the last cell of every spatial axis. A key moved by up to HALO cells along any axis, in either
# direction, lands in such a gap and never on a cell of the next row, so look-ups need no bounds test.
HALO = 2


@dataclass(eq=False)
class Sites:
    """Active cells of a batch of grids, unique and in lexicographic order.

    `shape` is (batch, *spatial), for example (B, rows, cols) or (B, z, y, x); `keys` [n] int64 are sorted and unique.
    `cache` holds what was derived from this set (kernel maps), so every layer that works on the same `Sites` object
    shares them. Build with `from_indices`, `unique`, `unique_keys` or `from_linear`; the constructor trusts what it is
    given.
    In fixed shapes (`ops/fixed_shapes.py`) padding stands behind the sites, its key `end` in every row.
    """

    shape: tuple[int, ...]
    keys: Tensor  # [n] int64, sorted, unique
    cache: dict[Any, Any] = field(default_factory=dict, repr=False)

    @classmethod
    def from_indices(
        cls,
        indices: Tensor,  # [n, 1 + d] int64 (batch, *cell), any order, unique
        shape: tuple[int, ...],
    ) -> tuple[Sites, Tensor]:
        """Sites of the given cells, and `order` [n] int64 such that `indices[order]` are in the order of the sites.

        Raises ValueError for a cell outside `shape` or listed twice, which a CPU looks for: a GPU would have to wait.
        """
        empty = _checked_empty(indices, shape)
        keys, order = torch.sort(empty.keys_of(indices))
        sites = cls(empty.shape, keys)
        if indices.device.type == "cpu" and bool((keys[1:] == keys[:-1]).any()):
            raise ValueError(
                f"indices: {len(keys) - len(torch.unique(keys))} cells are listed more than once, expected unique "
                "cells; merge them first (Sites.unique gives the rows to merge into)"
            )
        return sites, order

    @classmethod
    def unique(
        cls,
        indices: Tensor,  # [n, 1 + d] int64 (batch, *cell), any order, repeats allowed
        shape: tuple[int, ...],
    ) -> tuple[Sites, Tensor]:
        """Sites of the distinct cells, and the row [n] int64 of every given cell in them.

        Raises ValueError for a cell outside `shape`, which a CPU looks for: a GPU would have to wait.
        """
        empty = _checked_empty(indices, shape)
        return cls.unique_keys(empty.keys_of(indices), empty.shape)

    @classmethod
    def unique_keys(
        cls,
        keys: Tensor,  # [n] int64, any order, repeats allowed; in fixed shapes those from `end` on are padding
        shape: tuple[int, ...],
    ) -> tuple[Sites, Tensor]:
        """As `unique`, from the keys of the cells, which are trusted."""
        sites, fixed = cls(tuple(shape), keys), fixed_shapes()
        if fixed is None:
            sites.keys, rows = torch.unique(keys, return_inverse=True)
        else:
            most = fixed.most_sites(sites.shape)
            sites.keys, rows, sites.cache["groups"] = fixed.grouped(keys, sites.end, most)
        return sites, rows

    @classmethod
    def from_linear(
        cls,
        linear: Tensor,  # [n] int64, sorted, unique: (batch * rows + row) * cols + col and alike for any d
        shape: tuple[int, ...],
    ) -> Sites:
        """Sites from plain row-major positions, which have the same order as the keys. Trusts its arguments."""
        sites = cls(tuple(shape), linear)
        sites.cache["linear"] = linear
        if linear.device.type == "cpu":
            cells = _unravelled(linear, _row_major(sites.shape), (2**62, *sites.shape[1:]))
            sites.keys, sites.cache["indices"] = sites.keys_of(cells), cells
        else:
            sites.keys = _counted_anew(linear, _row_major(sites.shape), sites.shape[1:], sites.strides)
        return sites

    def on_grid(self, shape: tuple[int, ...], axes: tuple[int, ...] | None) -> Sites:
        """The same cells on a grid of another size, with some of the axes (all of `shape` and the batch's) if given.

        Trusts that they lie in it and are as many; they keep their order.
        """
        sites, steps = Sites(tuple(shape), self.keys), [0] * len(self.shape)
        for axis, step in zip(axes or range(len(shape)), sites.strides, strict=True):
            steps[axis] = step
        sites.keys = self.positions(tuple(steps))
        return sites

    @property
    def strides(self) -> tuple[int, ...]:
        """Step of the key per axis of `shape`."""
        strides = [1]
        for size in reversed(self.shape[1:]):
            strides.append(strides[-1] * (size + HALO))
        return tuple(reversed(strides))

    @property
    def end(self) -> int:
        """The key behind the last cell's."""
        return self.shape[0] * self.strides[0]

    @property
    def ndim(self) -> int:
        """Number of spatial axes."""
        return len(self.shape) - 1

    @property
    def device(self) -> torch.device:
        """Device of the keys."""
        return self.keys.device

    def __len__(self) -> int:
        return len(self.keys)

    def indices(self) -> Tensor:  # [n, 1 + d] int64
        """(batch, *cell) of every site, in order."""
        if "indices" not in self.cache:
            sizes = (2**62, *(size + HALO for size in self.shape[1:]))
            self.cache["indices"] = _unravelled(self.keys, self.strides, sizes)
        return self.cache["indices"]

    def linear(self) -> Tensor:  # [n] int64
        """Row-major position of every site, (batch * rows + row) * cols + col in 2D; sorted."""
        if "linear" not in self.cache:
            self.cache["linear"] = self.positions(_row_major(self.shape))
        return self.cache["linear"]

    def positions(
        self,
        steps: tuple[int, ...],  # per axis of `shape`
        first: int = 0,
    ) -> Tensor:  # [n] int64
        """(batch, *cell) of every site times the steps, summed on `first`: keys of another grid, linear positions."""
        if self.device.type == "cpu":
            found = (self.indices() * constant(steps, torch.int64, self.device)).sum(1)
            return found + first if first else found
        return _counted_anew(self.keys, self.strides, tuple(size + HALO for size in self.shape[1:]), steps, first)

    @property
    def groups(self) -> Groups | None:
        """Which of the given cells each site of `unique` is, known in fixed shapes."""
        return self.cache.get("groups")

    def rows_of(
        self,
        indices: Tensor,  # [q, 1 + d] int64, may lie outside the grid
    ) -> Tensor:  # [q] int64
        """Row of each cell among the sites, -1 where it is absent or outside the grid."""
        upper = constant(self.shape, torch.int64, indices.device)
        inside = ((indices >= 0) & (indices < upper)).all(1)
        return where_scalar(inside, rows_of_keys(self.keys, self.keys_of(indices)), -1)

    def nearest_rows(
        self,
        keys: Tensor,  # [q] int64
    ) -> Tensor:  # [q] int64
        """Row of each key; a row that exists also where the key does not. In fixed shapes padding for padding."""
        return torch.searchsorted(self.keys, keys).clamp_(max=len(self) - 1)

    def keys_of(
        self,
        indices: Tensor,  # [q, 1 + d] int64, at most HALO cells outside the grid
    ) -> Tensor:  # [q] int64
        """Key of each cell, a site or not."""
        return (indices.long() * constant(self.strides, torch.int64, indices.device)).sum(1)


def _row_major(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Step of a linear position per axis."""
    return tuple(math.prod(shape[axis + 1 :]) for axis in range(len(shape)))


def _counted_anew(
    positions: Tensor,  # [n] int64
    strides: tuple[int, ...],
    sizes: tuple[int, ...],  # of each axis but the first, as the strides count them
    steps: tuple[int, ...],
    first: int = 0,
) -> Tensor:  # [n] int64
    """The positions with other strides, counted from `first`, in one launch."""
    columns = zip(strides[1:], sizes, steps[1:], strict=True)
    axes = tuple((stride, size, 1, 1, 0, size, step) for stride, size, step in columns)
    shift = (1, 1, 1, 1, 0, first + 1, 1)  # an axis with the cell 0 alone, moved by `first`
    return moved_keys(positions, (strides[0], steps[0]), (*axes, shift), ((0,) * len(sizes) + (first,),))[0]


def _unravelled(
    positions: Tensor,  # [n] int64
    strides: tuple[int, ...],
    sizes: tuple[int, ...],  # of each axis, as the strides count them
) -> Tensor:  # [n, axes] int64
    """The place of each position on every axis."""
    if positions.device.type == "cpu":  # where a division costs more than another pass
        rest, columns = positions, []
        for stride in strides:
            columns.append(torch.div(rest, stride, rounding_mode="floor"))
            rest = rest - columns[-1] * stride
        return torch.stack(columns, 1)
    steps, sizes = constant((strides, sizes), torch.int64, positions.device)
    return torch.remainder(torch.div(positions[:, None], steps, rounding_mode="floor"), sizes)


def rows_of_keys(
    keys: Tensor,  # [n] int64, sorted, unique
    wanted: Tensor,  # [q] int64
) -> Tensor:  # [q] int64
    """Row of each wanted key among the sorted keys, -1 where it is absent."""
    if len(keys) == 0:
        return torch.full_like(wanted, -1)
    rows = torch.searchsorted(keys, wanted).clamp_(max=len(keys) - 1)
    return where_scalar(keys[rows] == wanted, rows, -1)


def places_among(
    part: Sites,
    joint: Sites,
) -> Tensor:  # [n of joint] int32
    """Row that each site of `joint` has in `part`, -1 for none. In fixed shapes padding has some of padding, or -1."""
    return neighbour_table(part.keys, joint.keys, constant((0,), torch.int64, joint.device))[0][0]


def padded_sites(
    keys: Tensor,  # [n] int64, any order, repeats allowed; those from `end` on, of which there are some, are padding
    shape: tuple[int, ...],
) -> Sites:
    """The sites of these keys in fixed shapes."""
    fixed, sites = fixed_shapes(), Sites(shape, keys)
    sites.keys = fixed.distinct(keys, sites.end, fixed.most_sites(shape))
    return sites


def union(a: Sites, b: Sites) -> tuple[Sites, Tensor, Tensor]:
    """Sites of either set, and the rows of a [len a] and of b [len b] in it, both int64.

    Raises ValueError when the two sets live on different grids.
    """
    if a.shape != b.shape:
        raise ValueError(f"union of sites on different grids: shapes {a.shape} and {b.shape} must be equal")
    if a is b:
        rows = arange(len(a), torch.int64, a.device)
        return a, rows, rows
    keys = torch.cat([a.keys, b.keys])
    if fixed_shapes() is not None:
        joint, rows = Sites.unique_keys(keys, a.shape)
        return joint, *rows.split([len(a), len(b)])
    keys = torch.unique(keys)
    return Sites(a.shape, keys), torch.searchsorted(keys, a.keys), torch.searchsorted(keys, b.keys)


def _checked_empty(indices: Tensor, shape: tuple[int, ...]) -> Sites:
    """A set without sites on the grid, after checking that the indices fit it."""
    if indices.dim() != 2 or indices.shape[1] != len(shape) or indices.is_floating_point():
        raise ValueError(
            f"indices: expected integers [n, {len(shape)}] for shape {tuple(shape)}, "
            f"got {indices.dtype} {list(indices.shape)}"
        )
    if any(size < 1 for size in shape[1:]) or shape[0] < 0:
        raise ValueError(f"shape={tuple(shape)}: every spatial size must be at least 1")
    sites = Sites(tuple(int(size) for size in shape), indices.new_empty(0, dtype=torch.int64))
    if math.prod(size + HALO for size in sites.shape) >= 2**63:
        raise ValueError(f"shape={sites.shape}: too many cells for 64-bit keys")
    if indices.device.type == "cpu" and fixed_shapes() is None:  # where padding is outside
        outside = (indices < 0) | (indices >= constant(sites.shape, torch.int64, indices.device))
        if bool(outside.any()):
            first = indices[outside.any(1)][0].tolist()
            raise ValueError(f"indices: cell {first} lies outside shape {sites.shape}; drop such cells first")
    return sites
