"""Numbers of the host on a device, without making the host wait for it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

Values = tuple[float | int | bool, ...] | tuple[tuple[float | int | bool, ...], ...]


@lru_cache(maxsize=256)
def constant(values: Values, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The tensor of these values; the same object every time, so nobody may write into it."""
    with torch.inference_mode(False):  # made in a validation, it must still serve a backward pass
        return on_device(values, dtype, device)


def on_device(
    values: Sequence[Any],  # numbers, or rows of numbers
    dtype: torch.dtype,
    device: torch.device,
) -> Tensor:
    """The tensor of these values; from pinned memory, because a copy from other memory waits for a GPU."""
    tensor = torch.tensor(values, dtype=dtype)
    return tensor if device.type == "cpu" else tensor.pin_memory().to(device, non_blocking=True)
