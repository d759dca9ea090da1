"""Keys of sites on another grid: cells multiplied, shifted and divided axis by axis, as kernel maps need them."""

from __future__ import annotations

import torch
from torch import Tensor

from src.geometry.constants import constant, where_scalar
from src.ops.backend import implementation

NONE = torch.iinfo(torch.int64).max
"""The key of what does not fit; larger than any other."""

Axis = tuple[int, int, int, int, int, int, int]
"""step and size in the old key, factor, divisor, low and high of the new cells, step in the new key."""


def moved_keys(
    keys: Tensor,  # [n] int64
    samples: tuple[int, int],  # step of a sample in the old key and in the new one
    axes: tuple[Axis, ...],
    shifts: tuple[tuple[int, ...], ...],  # of each tap by axis
) -> Tensor:  # [K, n] int64
    """Key of (cell * factor + shift) / divisor for every tap and site, NONE where that is no whole cell in low..high.

    No shift is below -8 divisors.
    """
    return implementation(moved_keys_reference)(keys, samples, axes, shifts)


def moved_keys_reference(
    keys: Tensor, samples: tuple[int, int], axes: tuple[Axis, ...], shifts: tuple[tuple[int, ...], ...]
) -> Tensor:
    """Plain torch form."""
    device = keys.device
    step, size, factor, divisor, low, high, new_step = constant(axes, torch.int64, device).unbind(1)
    cells = torch.div(keys[:, None], step, rounding_mode="floor") % size * factor  # [n, d]
    moved = cells + constant(shifts, torch.int64, device)[:, None]  # [K, n, d]
    target = torch.div(moved, divisor, rounding_mode="floor")
    fits = ((target * divisor == moved) & (target >= low) & (target < high)).all(-1)
    found = (target * new_step).sum(-1) + torch.div(keys, samples[0], rounding_mode="floor") * samples[1]
    return where_scalar(fits, found, NONE)
