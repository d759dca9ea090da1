"""Dataclasses of tensors, taken as one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import Any, Self

import torch
from torch import Tensor


class TensorFields:
    """Base of a dataclass that holds tensors, others of its kind, lists or tuples of them, and plain values."""

    @classmethod
    def concatenate(cls, parts: Sequence[Self], dim: int) -> Self:
        """All parts joined along one axis of every tensor, in order; at least one part, of tensors alone.

        A field is None where it is in all of them.
        """
        columns = {field.name: [getattr(part, field.name) for part in parts] for field in fields(cls)}
        empty = {name for name, values in columns.items() if all(value is None for value in values)}
        return cls(**{name: None if name in empty else torch.cat(values, dim) for name, values in columns.items()})

    def map(self, function: Callable[[Tensor], Tensor]) -> Self:
        """The same with `function` applied to every tensor."""
        return type(self)(**{field.name: _mapped(getattr(self, field.name), function) for field in fields(self)})

    def to(self, device: torch.device | str, non_blocking: bool = False) -> Self:
        """The same on another device."""
        return self.map(lambda value: value.to(device, non_blocking=non_blocking))

    def tensors(self) -> list[Tensor]:
        """Every tensor, in the order in which `map` takes them."""
        found: list[Tensor] = []
        self.map(lambda value: found.append(value) or value)
        return found

    def pin_memory(self) -> Self:
        """The same in page-locked memory, for the loader's transfer to a GPU."""
        return self.map(lambda value: value.pin_memory())


def _mapped(value: Any, function: Callable[[Tensor], Tensor]) -> Any:
    if isinstance(value, Tensor):
        return function(value)
    if isinstance(value, TensorFields):
        return value.map(function)
    return type(value)(_mapped(item, function) for item in value) if isinstance(value, (list, tuple)) else value
