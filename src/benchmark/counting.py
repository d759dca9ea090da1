"""Arithmetic and memory traffic of whatever runs, operation by operation, inside hand-written gradients too."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import flop_registry

from src.ops import backend

aten = torch.ops.aten

# Operations that give out memory without writing it, or names for memory that exists.
FREE = {aten.detach, aten.alias, aten.empty, aten.empty_strided, aten.empty_like, aten.new_empty, aten.resize_}


@dataclass
class Work:
    """What ran inside `counted_work`."""

    flops: int = 0  # of matrix products, convolutions and attention: two per multiply-add
    bytes: int = 0  # inputs and outputs of every operation but views: the traffic without fusion and without a cache


@contextmanager
def counted_work() -> Iterator[Work]:
    """Count all tensor operations within the context, backward passes included.

    Operations with kernels of their own run in the torch reference meanwhile, whose products can be seen.
    """
    work, chosen = Work(), backend.chosen()
    backend.use(backend.REFERENCE)
    try:
        with _Counter(work):
            yield work
    finally:
        backend.use(chosen)


class _Counter(TorchDispatchMode):
    def __init__(self, work: Work) -> None:
        super().__init__()
        self.work = work

    def __torch_dispatch__(
        self, func: Any, types: tuple[type, ...], args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs = kwargs or {}
        result = func(*args, **kwargs)
        packet = func.overloadpacket
        if not func.is_view and packet not in FREE:
            inputs = [args, {name: value for name, value in kwargs.items() if name != "out"}]
            self.work.bytes += sum(x.nbytes for x in tree_leaves([inputs, result]) if isinstance(x, Tensor))
        if packet in FORMULAS:
            self.work.flops += FORMULAS[packet](*args, **kwargs)
        elif packet in flop_registry:
            self.work.flops += flop_registry[packet](*args, **kwargs, out_val=result)
        return result


def product_flops(rows: int, inner: int, cols: int) -> int:
    """Of one matrix product."""
    return 2 * rows * inner * cols


def _grouped(left: Tensor, right: Tensor, *_: Any, **__: Any) -> int:
    """Rows of `left` meet one matrix each; two plain matrices are cut along the inner axis, and each part counts."""
    return product_flops(math.prod(left.shape[:-1]), left.shape[-1], right.shape[-1])


def _added(self: Tensor, left: Tensor, right: Tensor, *_: Any, **__: Any) -> int:
    return math.prod(left.shape[:-2]) * product_flops(left.shape[-2], left.shape[-1], right.shape[-1])


def _attention(query: Tensor, key: Tensor, value: Tensor, *_: Any, **__: Any) -> int:
    return math.prod(query.shape[:-1]) * key.shape[-2] * 2 * (query.shape[-1] + value.shape[-1])


def _attention_gradient(grad: Tensor, query: Tensor, key: Tensor, value: Tensor, *_: Any, **__: Any) -> int:
    """Scores anew, and four products: of values, probabilities, queries and keys."""
    return math.prod(query.shape[:-1]) * key.shape[-2] * 2 * (3 * query.shape[-1] + 2 * value.shape[-1])


FORMULAS: dict[Any, Callable[..., int]] = {
    aten._grouped_mm: _grouped,
    aten.addmm_: _added,
    aten.baddbmm_: _added,
    aten._scaled_dot_product_flash_attention_for_cpu: _attention,
    aten._scaled_dot_product_flash_attention_for_cpu_backward: _attention_gradient,
}
"""What torch's own table lacks."""


def distinct_bytes(tensors: list[Tensor]) -> int:
    """Bytes of the tensors, those that share memory once."""
    return sum({(x.data_ptr(), x.nbytes): x.nbytes for x in tensors}.values())
