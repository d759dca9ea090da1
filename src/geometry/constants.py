"""Numbers of the host on a device, without making the host wait for it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import torch
from torch import Tensor

Values = tuple[float | int | bool, ...] | tuple[tuple[float | int | bool, ...], ...]


@cache  # for good: a captured CUDA graph reads them
def constant(values: Values, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The tensor of these values; the same object every time, so nobody may write into it."""
    with torch.inference_mode(False):  # made in a validation, it must still serve a backward pass
        return on_device(values, dtype, device)


def arange(
    count: int,
    dtype: torch.dtype,
    device: torch.device,
) -> Tensor:  # [count]
    """0, 1, 2, ...: the head of a sequence that is kept, so a launch less than `arange`; nobody may write into it."""
    return _sequence(max(count - 1, 0).bit_length(), dtype, device)[:count]


@cache  # as above; of each power of two one
def _sequence(bits: int, dtype: torch.dtype, device: torch.device) -> Tensor:  # [2 ** bits]
    with torch.inference_mode(False):
        return torch.arange(2**bits, dtype=dtype, device=device)


@cache  # as above
def repeat_interleave(
    counts: tuple[int, ...],
    device: torch.device,
) -> Tensor:  # [sum of the counts] int64
    """0 as often as the first count says, 1 as often as the second, ...; nobody may write into it."""
    with torch.inference_mode(False):
        return upload([torch.arange(len(counts)).repeat_interleave(torch.tensor(counts))], device)[0]


def where_scalar(
    kept: Tensor,  # [...] bool
    values: Tensor,  # [...]
    other: float | int,
) -> Tensor:  # [...]
    """`torch.where` with a number for what is not kept, which is made once and not in every call."""
    return torch.where(kept, values, constant((other,), values.dtype, values.device))


def on_device(
    values: Sequence[Any],  # numbers, or rows of numbers
    dtype: torch.dtype,
    device: torch.device,
) -> Tensor:
    """The tensor of these values; from pinned memory, because a copy from other memory waits for a GPU."""
    return upload([torch.tensor(values, dtype=dtype)], device)[0]


def upload(
    tensors: Sequence[Tensor],
    device: torch.device,
) -> list[Tensor]:
    """The tensors on a device: from the host one copy for all of a type, for which it does not wait."""
    if not tensors or tensors[0].device.type == device.type:
        return list(tensors)
    found = list(tensors)
    for dtype in dict.fromkeys(tensor.dtype for tensor in tensors):
        places = [place for place, tensor in enumerate(tensors) if tensor.dtype == dtype]
        joined = torch.cat([tensors[place].flatten() for place in places]).pin_memory()
        parts = joined.to(device, non_blocking=True).split([tensors[place].numel() for place in places])
        for place, part in zip(places, parts, strict=True):
            found[place] = part.view(tensors[place].shape)
    return found
