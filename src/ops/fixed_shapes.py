"""Fixed shapes: within their context every set has a stated capacity, so that nothing waits for a count.

Rows behind the members of a set are padding. A padded set of sites ends in the key `Sites.end`, in at least one row
unless it overflows: one step beyond the last cell, (B, 0, ...) of a sample that does not exist. Convolutions never
carry padding into other rows, and what sums, ranks or samples rows leaves that sample out. A set that overflows gives
wrong results, but names no row beyond its capacity; `FixedShapes.overflow` says so.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field

import torch
from torch import Tensor

from src.geometry.constants import constant
from src.ops.distinct_keys import Groups, distinct_keys, grouped_keys


@dataclass(frozen=True)
class Capacities:
    """The most rows of each kind that a frame may have in fixed shapes. Raises ValueError for a number below 1."""

    points: int  # radar points
    voxels: int  # sites of any set but those of the next line
    cells: int  # sites of a set on the BEV grid
    pairs: int  # (Gaussian, cell) pairs that the windows of all Gaussians make

    def __post_init__(self) -> None:
        if min(self.points, self.voxels, self.cells, self.pairs) < 1:
            raise ValueError(f"{self}: each must be at least 1")


@dataclass
class FixedShapes:
    """Capacities in use, and what has been counted against them."""

    capacities: Capacities
    plane: tuple[int, int]  # (rows, cols) of the BEV grid
    _lasts: list[Tensor] = field(default_factory=list)  # [1] int64, the last key of each set
    _ends: list[int] = field(default_factory=list)  # what it is unless the set overflows

    def most_sites(
        self,
        shape: tuple[int, ...],  # of their grid
    ) -> int:
        """Capacity of a set of sites."""
        flat = shape[-2:] == self.plane and math.prod(shape[1:]) == math.prod(self.plane)
        return self.capacities.cells if flat else self.capacities.voxels

    def distinct(
        self,
        keys: Tensor,  # [n] int64, any from `end` on is padding, of which there is some
        end: int,
        most: int,
    ) -> Tensor:  # [min(n, most + 1)] int64
        """The distinct keys in ascending order, `end` behind them."""
        found = distinct_keys(keys, end, min(most + 1, len(keys)))
        self.expect(found[-1:], end)
        return found

    def grouped(
        self,
        keys: Tensor,  # [n] int64, as above
        end: int,
        most: int,
    ) -> tuple[Tensor, Tensor, Groups]:  # [min(n, most + 1)], [n] int64
        """As `distinct`; the place of each key among the distinct ones, padding for padding; equal keys as groups."""
        found, rows, groups = grouped_keys(keys, end, min(most + 1, len(keys)))
        self.expect(found[-1:], end)
        return found, rows, groups

    def places(
        self,
        chosen: Tensor,  # [n] bool
        size: int,
    ) -> Tensor:  # [size] int64
        """Places of the chosen rows, n behind them."""
        return torch.nonzero_static(chosen, size=size, fill_value=len(chosen)).squeeze(1)

    def expect(
        self,
        value: Tensor,  # [1] int64
        least: int,
    ) -> None:
        """Note the last key of a set: a value below `least` means that the set has overflowed."""
        self._lasts.append(value)
        self._ends.append(least)

    def overflow(self) -> Tensor:  # [] bool
        """Whether any set so far has overflowed."""
        lasts = torch.cat(self._lasts)
        return (lasts < constant(tuple(self._ends), torch.int64, lasts.device)).any()


_shapes: ContextVar[FixedShapes | None] = ContextVar("fixed shapes", default=None)


def fixed_shapes() -> FixedShapes | None:
    """The fixed shapes of the context; None outside of one, where sets have the size of their content."""
    return _shapes.get()


@contextmanager
def in_fixed_shapes(shapes: FixedShapes) -> Iterator[FixedShapes]:
    """Within the context sets have these capacities. For inference: gradients are not passed on."""
    token = _shapes.set(shapes)
    try:
        yield shapes
    finally:
        _shapes.reset(token)
