"""Matrix products on a CPU, by the library and in the type that multiply fastest there."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

ROW_STEP = 256
"""oneDNN makes a program for every shape it meets, about half a millisecond each: rows come in multiples of this."""
MOST_ROWS = 4096
"""Most rows of one product, whose operands and result then fit the cache."""
LEAST_ROWS, LEAST_WIDTHS = 512, (32, 64)
"""Products of fewer rows, or of matrices narrower than this on their narrow and on their wide side, stay as they are:
the operands' rounding costs what bfloat16 saves."""
LEAST_CHANNELS = 16
"""Convolutions with fewer input or output channels likewise stay as they are; their rows are those of the output."""

_bfloat16: ContextVar[bool] = ContextVar("bfloat16 products", default=False)


@contextmanager
def bfloat16_products(wanted: bool = True) -> Iterator[None]:
    """Within the context large products of float32 on a CPU that has the instructions take operands in bfloat16.

    Each is chosen by `product_type` or `convolution_type`, and its gradients follow it. Sums, and everything else, stay
    in float32.
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


def convolution_type(
    x: Tensor,  # [B, C, H, W]
    weight: Tensor,  # [C', C, k, k]
    stride: int,
) -> torch.dtype:
    """The type in which maps are best convolved: their own, or bfloat16 in its context, but not in compiled parts."""
    if torch.compiler.is_compiling() or x.dtype != torch.float32 or x.device.type != "cpu" or not _bfloat16.get():
        return x.dtype  # a compiler cannot read the context, and would take sizes for conditions
    large = len(x) * x.shape[2] * x.shape[3] >= LEAST_ROWS * stride**2 and min(weight.shape[:2]) >= LEAST_CHANNELS
    return torch.bfloat16 if large else x.dtype


def matmul(
    a: Tensor,  # [n, k]
    b: Tensor,  # [k, m]
    bias: Tensor | None = None,  # [m]
    relu: bool = False,
) -> Tensor:  # [n, m]
    """a @ b + bias, or its positive part, without gradient, in their own type whatever autocast says.

    In float32 by oneDNN where MKL leaves half of a processor unused, in bfloat16 where that spares a pass for the ReLU.
    Operands must not be expanded ones: oneDNN takes a thousand times as long for a value that stands for many. It also
    has no fast code for a part of a wider matrix, so of b such a part is copied.
    """
    if not (b.is_contiguous() or b.t().is_contiguous()):
        b = b.contiguous()
    full, half = a.dtype == torch.float32, a.dtype == torch.bfloat16 and relu
    if a.device.type == "cpu" and ((full and prefers_onednn()) or (half and fuses_bfloat16())):
        return torch.ops.mkldnn._linear_pointwise(a, b.t(), bias, "relu" if relu else "none", [], "")
    with torch.autocast(a.device.type, enabled=False):
        out = torch.mm(a, b) if bias is None else torch.addmm(bias, a, b)
    return out.relu_() if relu else out


def matmul_tn(
    a: Tensor,  # [n, k]
    b: Tensor,  # [n, m]
) -> Tensor:  # [k, m]
    """a^T @ b as by `matmul`, with the narrower operand on the left: oneDNN takes up to five times as long else."""
    return matmul(a.t(), b) if a.shape[1] <= b.shape[1] else matmul(b.t(), a).t()


def row_spans(rows: int, most: int) -> Iterator[slice]:
    """Slices of at most so many rows."""
    return (slice(first, min(first + most, rows)) for first in range(0, rows, most))


def whole_steps(
    rows: Tensor,  # [n, C]
) -> Tensor:  # [n up to a step, C]
    """On a CPU the rows with zeros behind them up to a multiple of ROW_STEP."""
    missing = row_steps(len(rows)) - len(rows)
    return F.pad(rows, (0, 0, 0, missing)) if missing and rows.device.type == "cpu" else rows


def row_steps(rows: int) -> int:
    """The number of rows rounded up to a multiple of ROW_STEP."""
    return -(-rows // ROW_STEP) * ROW_STEP


@cache
def multiplies_bfloat16() -> bool:
    """Whether this processor multiplies bfloat16."""
    found = torch.cpu.get_capabilities()
    return torch.backends.mkldnn.is_available() and bool(found.get("avx512_bf16") or found.get("amx_bf16"))


@cache
def fuses_bfloat16() -> bool:
    """Whether oneDNN has products of bfloat16 here, if slow ones, which take the ReLU along."""
    return torch.backends.mkldnn.is_available() and torch.ops.mkldnn._is_mkldnn_bf16_supported()


@cache
def prefers_onednn() -> bool:
    """Whether float32 goes to oneDNN: MKL takes AVX2 on processors of others than Intel, half the rate of AVX-512."""
    found = torch.cpu.get_capabilities()
    ours = torch.backends.mkldnn.is_available() and torch.backends.mkl.is_available()
    return ours and bool(found.get("avx512_f")) and "AMD" in found.get("cpu_name", "")


@cache
def slow_weight_gradients() -> bool:
    """Whether oneDNN's gradients of convolution weights, channels last, take longer than matrix products.

    Seen with AVX2 alone for 32 to 192 channels; with AVX-512 not measured, so left to oneDNN.
    """
    found = torch.cpu.get_capabilities()
    return bool(found.get("avx2")) and not found.get("avx512_f")


def describe_products(wanted: bool) -> dict[str, Any]:
    """What a CPU multiplies by and in, where bfloat16 is wanted or not, for the record of a run."""
    widths = f"widths of {LEAST_WIDTHS[0]} and {LEAST_WIDTHS[1]}"
    large = f"from {LEAST_ROWS} rows and {widths}; convolutions from {LEAST_CHANNELS} channels"
    return {
        "float32": "oneDNN" if prefers_onednn() else "torch",
        "bfloat16": large if wanted and multiplies_bfloat16() else "never",
    }
