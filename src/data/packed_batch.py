"""A batch packed for the transfer from a loader's worker to the training process."""

from __future__ import annotations

import io
import pickle
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from src.structures.batch import FrameBatch

LARGE_BYTES = 2**18
"""From this size on shared memory is cheaper than sending bytes."""


@dataclass
class PackedBatch:
    """Large tensors as they are, everything else as bytes.

    Torch sends each tensor of a worker as a file of shared memory of its own: opened, mapped and handed over a socket,
    half a millisecond of both processes. A batch has a score of small ones, seven for each frame's boxes.
    """

    content: bytes
    large: list[Tensor]

    @classmethod
    def pack(cls, batch: FrameBatch) -> PackedBatch:
        """Pack a batch; `unpack` restores it."""
        buffer = io.BytesIO()
        pickler = _Pickler(buffer, protocol=pickle.HIGHEST_PROTOCOL)
        pickler.dump(batch)
        return cls(buffer.getvalue(), pickler.large)

    def unpack(self) -> FrameBatch:
        """The batch; its large tensors still lie in the shared memory."""
        unpickler = _Unpickler(io.BytesIO(self.content))
        unpickler.large = self.large
        return unpickler.load()

    def pin_memory(self) -> FrameBatch:
        """The batch in page-locked memory; the loader's thread calls this."""
        return self.unpack().pin_memory()


class _Pickler(pickle.Pickler):
    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self.large: list[Tensor] = []

    def persistent_id(self, value: Any) -> int | None:
        if not (isinstance(value, Tensor) and value.nbytes >= LARGE_BYTES):
            return None
        self.large.append(value)
        return len(self.large) - 1

    def reducer_override(self, value: Any) -> Any:
        return (torch.from_numpy, (value.numpy(),)) if isinstance(value, Tensor) else NotImplemented


class _Unpickler(pickle.Unpickler):
    large: list[Tensor]

    def persistent_load(self, number: int) -> Tensor:
        return self.large[number]
