"""LayerNorm with the sums and the ReLU around it by one Triton launch."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from src.ops.add_layer_norm import Affine, add_layer_norm_reference, relu_norm_columns_reference
from src.ops.backend import runs_kernels

DTYPES = (torch.float32, torch.float16, torch.bfloat16)
ROWS = 8
"""Rows of a program."""
MOST_CHANNELS = 1024
"""A program holds its rows at once."""


def add_layer_norm_triton(
    x: Tensor, affine: Affine, eps: float, added: Tensor | None = None, relu: bool = False, then: Tensor | None = None,
    aged: tuple[Tensor, Tensor] | None = None,
) -> tuple[Tensor, Tensor | None]:  # fmt: skip
    """The reference's sums up to rounding, in float32; its results are float32 under autocast, as torch's norm's."""
    rows = [value for value in (added, then, aged and aged[0]) if value is not None]
    fits = all(value is not None and value.dtype in DTYPES for value in (x, *affine, *rows, *(aged or ())))
    fits = fits and all(value.shape == x.shape for value in rows) and x.shape[-1] <= MOST_CHANNELS
    if not (fits and runs_kernels(x)):
        return add_layer_norm_reference(x, affine, eps, added, relu, then, aged)
    out = x.new_empty(x.shape, dtype=_result_type(x, added))
    behind = None if then is None else torch.empty_like(out, dtype=_result_type(out, then))
    _launch(x, out, eps, (False, relu), 1, affine, added, then, aged, behind)
    return out, behind


def relu_norm_columns_triton(hidden: Tensor, eps: float) -> Tensor:
    """The reference's norms up to rounding."""
    parts, num, channels = hidden.shape
    if hidden.dtype not in DTYPES or channels > MOST_CHANNELS or not runs_kernels(hidden):
        return relu_norm_columns_reference(hidden, eps)
    out = hidden.new_empty((num, parts * channels), dtype=_result_type(hidden))
    _launch(hidden, out, eps, (True, False), parts)
    return out


def _result_type(x: Tensor, other: Tensor | None = None) -> torch.dtype:
    if torch.is_autocast_enabled(x.device.type):
        return torch.float32
    return x.dtype if other is None else torch.promote_types(x.dtype, other.dtype)


def _launch(
    x: Tensor,  # [..., C]
    out: Tensor,  # of as many values
    eps: float,
    relus: tuple[bool, bool],  # before and behind the norm
    columns: int,  # that many runs of rows come to lie side by side
    affine: Affine | None = None,
    added: Tensor | None = None,
    then: Tensor | None = None,
    aged: tuple[Tensor, Tensor] | None = None,
    behind: Tensor | None = None,
) -> None:
    if x.numel() == 0:
        return
    channels = x.shape[-1]
    num = x.numel() // channels
    optional = (added, *(affine or (None, None)), then, *(aged or (None, None)))
    with torch.cuda.device_of(out):
        _sum_norm[(triton.cdiv(num, ROWS),)](
            *(x.contiguous(), *(out if value is None else value.contiguous() for value in optional)),
            *(out, out if behind is None else behind, num, channels, num // columns, columns, eps),
            ADDED=added is not None,
            AFFINE=affine is not None,
            RELU_FIRST=relus[0],
            RELU_LAST=relus[1],
            THEN=then is not None,
            AGED=aged is not None,
            BLOCK_ROWS=ROWS,
            BLOCK=triton.next_power_of_2(channels),
            num_warps=4,
        )


@triton.jit(do_not_specialize=["num", "own", "columns"])
def _sum_norm(  # noqa: ANN202
    x, added, scale, shift, then, embedded, ages, out, behind,  # noqa: ANN001
    num, channels, own, columns, eps,  # noqa: ANN001
    ADDED: tl.constexpr, AFFINE: tl.constexpr, RELU_FIRST: tl.constexpr, RELU_LAST: tl.constexpr,
    THEN: tl.constexpr, AGED: tl.constexpr, BLOCK_ROWS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """A block of rows, each of which becomes row (row % own) * columns + row // own."""
    row = tl.program_id(0).to(tl.int64) * BLOCK_ROWS + tl.arange(0, BLOCK_ROWS)
    lane = tl.arange(0, BLOCK)
    there, inside = row < num, lane < channels
    live = there[:, None] & inside[None, :]
    place = row[:, None] * channels + lane[None, :]
    total = tl.load(x + place, mask=live, other=0.0).to(tl.float32)
    if ADDED:
        total += tl.load(added + place, mask=live, other=0.0).to(tl.float32)
    if RELU_FIRST:
        total = tl.maximum(total, 0.0, propagate_nan=tl.PropagateNan.ALL)
    mean = tl.sum(total, 1) / channels
    total = tl.where(live, total - mean[:, None], 0.0)
    variance = tl.sum(total * total, 1) / channels
    total = total / tl.sqrt(variance + eps)[:, None]
    if AFFINE:
        total = total * tl.load(scale + lane, mask=inside, other=0.0).to(tl.float32)[None, :]
        total += tl.load(shift + lane, mask=inside, other=0.0).to(tl.float32)[None, :]
    if RELU_LAST:
        total = tl.maximum(total, 0.0, propagate_nan=tl.PropagateNan.ALL)
    target = ((row % own) * columns + row // own)[:, None] * channels + lane[None, :]
    tl.store(out + target, total.to(out.dtype.element_ty), mask=live)
    if THEN:
        total += tl.load(then + place, mask=live, other=0.0).to(tl.float32)
        if AGED:
            age = tl.load(ages + row, mask=there, other=0.0)
            extra = tl.load(embedded + place, mask=live, other=0.0).to(tl.float32)
            total += tl.where((age > 0.0)[:, None], extra, 0.0)
        tl.store(behind + place, total.to(behind.dtype.element_ty), mask=live)
