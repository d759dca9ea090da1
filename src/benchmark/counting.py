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
from torch.utils.flop_counter import FlopCounterMode, sdpa_backward_flop_count, sdpa_flop_count

from src.ops import backend

aten = torch.ops.aten

# Operations that give out memory without writing it, or names for memory that exists.
FREE = {aten.detach, aten.alias, aten.empty, aten.empty_strided, aten.empty_like, aten.new_empty, aten.resize_}

Shape = tuple[int, ...]


def _product(left: Shape, right: Shape, *_: Any, **__: Any) -> int:
    """FLOPs of a product; of a grouped one too: each row meets one matrix, or both are cut along the inner axis."""
    return 2 * math.prod(left) * right[-1]


def _added_product(self: Shape, left: Shape, right: Shape, *_: Any, **__: Any) -> int:
    return _product(left, right)


def _attention(query: Shape, key: Shape, value: Shape, *_: Any, **__: Any) -> int:
    return sdpa_flop_count(query, key, value)


def _attention_backward(grad: Shape, query: Shape, key: Shape, value: Shape, *_: Any, **__: Any) -> int:
    return sdpa_backward_flop_count(grad, query, key, value)


def _linear(rows: Shape, weight: Shape, *_: Any, **__: Any) -> int:
    return 2 * math.prod(rows) * weight[0]


FORMULAS: dict[Any, Callable[..., int]] = {
    aten._grouped_mm: _product,
    aten.addmm_: _added_product,
    aten.baddbmm_: _added_product,
    torch.ops.mkldnn._linear_pointwise: _linear,
    aten._scaled_dot_product_flash_attention_for_cpu: _attention,
    aten._scaled_dot_product_flash_attention_for_cpu_backward: _attention_backward,
}
"""What torch's own table lacks."""

# Its table without its context: the hooks of its module tracker add copies of gradients, which would count as traffic.
FLOPS = FlopCounterMode(display=False, custom_mapping=FORMULAS).flop_registry


@dataclass
class Work:
    """What ran inside `counted_work`."""

    flops: int = 0  # of matrix products, convolutions and attention: two per multiply-add
    bytes: int = 0  # inputs and outputs of every operation but views: the traffic without fusion and without a cache


@contextmanager
def counted_work() -> Iterator[Work]:
    """Count all tensor operations within the context, backward passes included.

    Operations with kernels of their own run in the torch reference meanwhile, whose products can be seen, and sparse
    convolutions multiply existing pairs only.
    """
    work, chosen = Work(), backend.chosen()
    backend.use(backend.COUNTED)
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
        kwargs, packet = kwargs or {}, func.overloadpacket
        if packet not in FLOPS:  # in inference mode a linear layer comes whole
            with self:
                result = func.decompose(*args, **kwargs)
            if result is not NotImplemented:
                return result
        result = func(*args, **kwargs)
        if not func.is_view and packet not in FREE:
            inputs = [args, {name: value for name, value in kwargs.items() if name != "out"}]
            self.work.bytes += sum(x.nbytes for x in tree_leaves([inputs, result]) if isinstance(x, Tensor))
        if packet in FLOPS:
            self.work.flops += FLOPS[packet](*args, **kwargs, out_val=result)
        return result


def distinct_bytes(tensors: list[Tensor]) -> int:
    """Bytes of the tensors, those that share memory once."""
    return sum({(x.data_ptr(), x.nbytes): x.nbytes for x in tensors}.values())
