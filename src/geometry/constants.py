"""Small tensors of fixed values, made once: copying a list to a GPU makes it wait."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

Values = tuple[float | int | bool, ...] | tuple[tuple[float | int | bool, ...], ...]


@lru_cache(maxsize=256)
def constant(values: Values, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The tensor of these values; the same object every time, so nobody may write into it."""
    with torch.inference_mode(False):  # made in a validation, it must still serve a backward pass
        return torch.tensor(values, dtype=dtype, device=device)
