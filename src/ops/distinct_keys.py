"""The distinct ones among keys in a stated number of places, and which keys are equal, without waiting for a GPU."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from src.geometry.constants import constant
from src.ops.backend import implementation


class Groups(NamedTuple):
    """Rows in groups, as segments."""

    order: Tensor  # [n] int64, the rows group by group, each in its order; those of no group last
    starts: Tensor  # [groups + 1] int64, where each group begins, and the end of the last


def distinct_keys(
    keys: Tensor,  # [n] int64, any from `end` on is padding, of which there is some
    end: int,
    size: int,  # at most n
) -> Tensor:  # [size] int64
    """The distinct keys in ascending order as far as they fit, `end` behind them."""
    return implementation(distinct_keys_reference)(keys, end, size)


def distinct_keys_reference(keys: Tensor, end: int, size: int) -> Tensor:
    """Plain torch form."""
    return _distinct(keys.sort().values, end, size)


def grouped_keys(
    keys: Tensor,  # [n] int64, as above
    end: int,
    size: int,
) -> tuple[Tensor, Tensor, Groups]:  # [size], [n] int64
    """`distinct_keys`; the place of each given key among them, of padding that of some `end`; and equal keys as groups.

    Where more keys are distinct than there are places, those behind the last have the last.
    """
    return implementation(grouped_keys_reference)(keys, end, size)


def grouped_keys_reference(keys: Tensor, end: int, size: int) -> tuple[Tensor, Tensor, Groups]:
    """Plain torch form."""
    ordered, order = keys.sort(stable=True)
    found = _distinct(ordered, end, size)
    starts = torch.searchsorted(ordered, torch.cat([found, constant((end,), keys.dtype, keys.device)]))
    return found, torch.searchsorted(found, keys).clamp_(max=size - 1), Groups(order, starts)


def _distinct(ordered: Tensor, end: int, size: int) -> Tensor:
    last = torch.nonzero_static(ordered[:-1] != ordered[1:], size=size, fill_value=len(ordered) - 1)  # of equal ones
    return ordered.index_select(0, last.squeeze(1)).clamp_(max=end)
