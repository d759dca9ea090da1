"""Matrix products on a CPU, by the library and in the type that multiply fastest there."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from typing import Any

import torch
from torch import Tensor

ROW_STEP = 256
"""oneDNN makes a program for every shape it meets, about half a millisecond each: rows come in multiples of this."""
LEAST_ROWS, LEAST_WIDTHS = 512, (32, 64)
"""Products of fewer rows, or of matrices narrower than this on their narrow and on their wide side, stay as they are:
the operands' rounding costs what bfloat16 saves."""

_bfloat16: ContextVar[bool] = ContextVar("bfloat16 products", default=False)


@contextmanager
def bfloat16_products(wanted: bool = True) -> Iterator[None]:
    """Within the context large products of float32 on a CPU that has the instructions take operands in bfloat16.

    Each is chosen by `product_type`, and its gradients follow it. Sums, and everything else, stay in float32.
    """
    token = _bfloat16.set(wanted and multiplies_bfloat16())
    try:
        yield
    finally:
        _bfloat16.reset(token)


def product_type(
    x: Tensor,  # [n, inner]
    outer: int,
) -> torch.dtype:
    """The type in which rows are best multiplied by an [inner, outer] matrix: their own, or bfloat16 in its context."""
    narrow, wide = sorted((x.shape[1], outer))
    large = len(x) >= LEAST_ROWS and narrow >= LEAST_WIDTHS[0] and wide >= LEAST_WIDTHS[1]
    if large and x.dtype == torch.float32 and x.device.type == "cpu" and _bfloat16.get():
        return torch.bfloat16
    return x.dtype


def multiply(
    a: Tensor,  # [n, k]
    b: Tensor,  # [k, m]
) -> Tensor:  # [n, m]
    """a @ b without gradient. In float32 by oneDNN where MKL leaves half of a processor unused."""
    if a.dtype == torch.float32 and a.device.type == "cpu" and prefers_onednn():
        return torch.ops.mkldnn._linear_pointwise(a, b.t(), None, "none", [], "")
    return torch.mm(a, b)


def row_steps(rows: int) -> int:
    """The number of rows rounded up to a multiple of ROW_STEP."""
    return -(-rows // ROW_STEP) * ROW_STEP


@cache
def multiplies_bfloat16() -> bool:
    """Whether this processor multiplies bfloat16."""
    found = torch.cpu.get_capabilities()
    return torch.backends.mkldnn.is_available() and bool(found.get("avx512_bf16") or found.get("amx_bf16"))


@cache
def prefers_onednn() -> bool:
    """Whether float32 goes to oneDNN: MKL takes AVX2 on processors of others than Intel, half the rate of AVX-512."""
    found = torch.cpu.get_capabilities()
    ours = torch.backends.mkldnn.is_available() and torch.backends.mkl.is_available()
    return ours and bool(found.get("avx512_f")) and "AMD" in found.get("cpu_name", "")


def describe_products() -> dict[str, Any]:
    """What is chosen in this context, for the record of a run."""
    large = f"from {LEAST_ROWS} rows and widths of {LEAST_WIDTHS[0]} and {LEAST_WIDTHS[1]}"
    return {
        "float32": "oneDNN" if prefers_onednn() else "torch",
        "bfloat16": large if _bfloat16.get() else "never",
    }
