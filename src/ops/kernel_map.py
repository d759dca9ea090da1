"""A kernel map (rulebook): which input site meets which output site at which kernel offset, as pairs or as a table."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from src.geometry.constants import on_device
from src.ops.neighbour_table import pairs_of_table, table_of_pairs, tap_bits, transposed_table
from src.ops.segment_reduce import inverse_rows, segments


@dataclass(eq=False)
class KernelMap:
    """Pairs (input row, output row) of a sparse convolution, grouped by kernel offset.

    Offsets run in C order over the kernel axes, as in a torch weight [Cout, Cin, k...]. `mirrored` marks a map whose
    transpose is itself with the offsets reversed (submanifold); `identity` one in which output i sees input i only.
    Within the block of an offset the inputs ascend, and so do the outputs. `cache` holds what was derived from the map.
    """

    inputs: Tensor  # [pairs] int32, input row
    outputs: Tensor  # [pairs] int32, output row
    counts: tuple[int, ...]  # pairs of each kernel offset; they lie one block after the other
    num_inputs: int
    num_outputs: int
    mirrored: bool = False
    identity: bool = False
    cache: dict[Any, Any] = field(default_factory=dict, repr=False)

    @property
    def num_offsets(self) -> int:
        """Number of kernel offsets K."""
        return len(self.counts)

    @cached_property
    def table(self) -> Tensor:  # [K, num_outputs] int32
        """Input row that each output sees through each offset, -1 where there is none."""
        return table_of_pairs(self.counts, self.outputs, self.inputs, self.num_outputs)

    @cached_property
    def order(self) -> Tensor:  # [num_outputs] int64
        """The outputs so that those which see through the same offsets stand together."""
        return torch.argsort(tap_bits(self.table), stable=True)

    @cached_property
    def ends(self) -> Tensor:  # [K] int32
        """End of each offset's block of pairs."""
        return on_device([*itertools.accumulate(self.counts)], torch.int32, self.inputs.device)

    @cached_property
    def transposed(self) -> KernelMap:
        """The map from its outputs to its inputs through the same offsets, as of a transposed convolution."""
        return KernelMap(self.outputs, self.inputs, self.counts, self.num_outputs, self.num_inputs)

    def keep_outputs(
        self,
        rows: Tensor,  # [m] int64, ascending
    ) -> KernelMap:
        """The map to these of its outputs only. Synchronises with a GPU."""
        new = inverse_rows(rows, self.num_outputs).to(torch.int32).index_select(0, self.outputs)
        kept = (new >= 0).nonzero().squeeze(1)
        pairs = (values.index_select(0, kept) for values in (self.inputs, new))
        return KernelMap(*pairs, tuple(counts_kept(kept, self).tolist()), self.num_inputs, len(rows))

    @cached_property
    def by_output(self) -> tuple[Tensor, Tensor]:
        """Pairs ordered by output row [pairs] int32 and the first pair of each row [num_outputs + 1] int32."""
        return segments(self.outputs, self.num_outputs)

    @cached_property
    def by_input(self) -> tuple[Tensor, Tensor]:
        """Pairs ordered by input row [pairs] int32 and the first pair of each row [num_inputs + 1] int32."""
        return segments(self.inputs, self.num_inputs)


class TableMap(KernelMap):
    """A kernel map held as a table, which a GPU makes without the host waiting; pairs are taken from it when asked for.

    Behaves as a `KernelMap` in all else.
    """

    def __init__(
        self,
        table: Tensor,  # [K, num_outputs] int32 input row, -1 for none
        num_inputs: int,
        mirrored: bool = False,
        bits: Tensor | None = None,  # [num_outputs] int64, see `tap_bits`
    ) -> None:
        self.__dict__["table"] = table
        self.bits, self.num_inputs, self.num_outputs = bits, num_inputs, table.shape[1]
        self.mirrored, self.identity, self.cache = mirrored, False, {}

    @cached_property
    def _pairs(self) -> tuple[Tensor, Tensor, tuple[int, ...]]:
        return pairs_of_table(self.table)

    inputs = property(lambda self: self._pairs[0])
    outputs = property(lambda self: self._pairs[1])
    counts = property(lambda self: self._pairs[2])

    @property
    def num_offsets(self) -> int:
        return len(self.table)

    @cached_property
    def order(self) -> Tensor:
        return torch.argsort(tap_bits(self.table) if self.bits is None else self.bits, stable=True)

    @cached_property
    def transposed(self) -> KernelMap:
        table, bits = transposed_table(self.table, self.num_inputs)
        return TableMap(table, self.num_outputs, bits=bits)

    def keep_outputs(self, rows: Tensor) -> KernelMap:
        return TableMap(self.table.index_select(1, rows), self.num_inputs)


def counts_kept(
    kept: Tensor,  # [n] int64, positions of pairs, ascending
    base: KernelMap,
) -> Tensor:  # [K] int64
    """How many of each offset's pairs were kept."""
    return torch.searchsorted(kept, base.ends.long()).diff(prepend=kept.new_zeros(1))
