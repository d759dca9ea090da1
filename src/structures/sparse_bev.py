"""Features on a set of active cells: sparse maps of any dimension, and the BEV map passed between the model's parts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from src.ops.sites import Sites, union


@dataclass
class SparseMap:
    """One feature vector per site of a batch of grids; rows follow the sites' lexicographic order.

    Maps that share the same `Sites` object also share its kernel maps.
    Raises ValueError when the rows do not match the sites.
    """

    sites: Sites  # M cells of a grid (batch, *spatial)
    features: Tensor  # [M, C]

    def __post_init__(self) -> None:
        name = type(self).__name__
        if self.features.dim() != 2 or len(self.features) != len(self.sites):
            raise ValueError(f"{name}.features must be [{len(self.sites)}, C], but got {list(self.features.shape)}")
        if self.features.device != self.sites.device:
            raise ValueError(f"{name}: features on {self.features.device}, but sites on {self.sites.device}")

    def __len__(self) -> int:
        return len(self.sites)

    @property
    def indices(self) -> Tensor:  # [M, 1 + d] int64
        """(batch, *cell) of every row."""
        return self.sites.indices()

    @property
    def batch_size(self) -> int:
        """B."""
        return self.sites.shape[0]

    @property
    def channels(self) -> int:
        """C."""
        return self.features.shape[1]

    def with_features(
        self,
        features: Tensor,  # [M, C']
    ) -> Self:
        """The same sites carrying other features."""
        return replace(self, features=features)

    def to_dense(self) -> Tensor:  # [B, C, *spatial]
        """The whole grid, zero where no site is active."""
        cells = torch.Size(self.sites.shape).numel()
        rows = self.features.new_zeros(cells, self.channels).index_copy(0, self.sites.linear(), self.features)
        return rows.view(*self.sites.shape, self.channels).movedim(-1, 1).contiguous()

    def union(self, other: Self) -> tuple[Self, Self]:
        """Both maps on the sites of either, with zeros where a map has no site; they share one `Sites` object.

        Raises ValueError when the grids differ.
        """
        sites, own_rows, other_rows = union(self.sites, other.sites)
        return self._spread(sites, own_rows), other._spread(sites, other_rows)

    def _spread(self, sites: Sites, rows: Tensor) -> Self:
        zeros = self.features.new_zeros(len(sites), self.channels)
        return type(self)(sites, zeros.index_copy(0, rows, self.features))


@dataclass
class SparseBEV(SparseMap):
    """A sparse map over the BEV grid, `indices` [M, 3] = (batch, row, col).

    Raises ValueError when its sites are not two-dimensional.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sites.ndim != 2:
            raise ValueError(f"SparseBEV.sites must lie on (batch, rows, cols), but got shape {self.sites.shape}")
