"""Sort keys of candidates, and candidates of sort keys, by a Triton launch each."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from src.geometry.constants import constant
from src.ops.backend import runs_kernels
from src.ops.candidate_sort_keys import (
    PLACE_BITS,
    ClassGroups,
    candidate_sort_keys_reference,
    unpack_candidates_reference,
)
from src.ops.kernel_maps import submanifold_map
from src.ops.sites import Sites

PAIRS = 256
"""Pairs of a program, one lane each."""


def candidate_sort_keys_triton(logits: Tensor, sites: Sites, groups: ClassGroups, peaks: bool) -> Tensor:
    """The reference's sort keys, of scores up to rounding."""
    if logits.dtype != torch.float32 or not runs_kernels(logits):
        return candidate_sort_keys_reference(logits, sites, groups, peaks)
    (num, classes), width = logits.shape, len(groups[0])
    sort_keys = sites.keys.new_empty(len(groups), num * width)
    if sort_keys.numel() > 0:
        neighbours = submanifold_map(sites, 3).table if peaks else sites.keys
        table = constant(groups, torch.int64, logits.device)
        with torch.cuda.device_of(logits):
            _sort_keys_of_pairs[(triton.cdiv(num * width, PAIRS), len(groups))](
                *(logits.contiguous(), sites.keys.contiguous(), neighbours.contiguous(), table, sort_keys),
                *(num, classes, sites.end),
                PEAKS=peaks,
                TAPS=9,
                WIDTH=width,
                BITS=PLACE_BITS,
                BLOCK=PAIRS,
                num_warps=4,
            )
    return sort_keys


def unpack_candidates_triton(sort_keys: Tensor, groups: ClassGroups, num_classes: int) -> tuple[Tensor, Tensor, Tensor]:
    """The reference's candidates."""
    if sort_keys.dtype != torch.int64 or not runs_kernels(sort_keys):
        return unpack_candidates_reference(sort_keys, groups, num_classes)
    scores = sort_keys.new_empty(sort_keys.shape, dtype=torch.float32)
    rows, labels = torch.empty_like(sort_keys), torch.empty_like(sort_keys)
    if sort_keys.numel() > 0:
        table = constant(groups, torch.int64, sort_keys.device)
        with torch.cuda.device_of(sort_keys):
            _candidates_of_sort_keys[(triton.cdiv(sort_keys.numel(), PAIRS),)](
                *(
                    sort_keys.contiguous(),
                    table,
                    scores,
                    rows,
                    labels,
                    sort_keys.numel(),
                    sort_keys.shape[1],
                    num_classes,
                ),
                WIDTH=len(groups[0]),
                BITS=PLACE_BITS,
                BLOCK=PAIRS,
                num_warps=4,
            )
    return scores, rows, labels


@triton.jit
def _score(logits, seen):  # noqa: ANN001, ANN202
    """Scores of logits; 0 of those that are not to be seen."""
    return tl.where(seen, 1.0 / (1.0 + tl.exp(-tl.load(logits, mask=seen, other=0.0))), 0.0)


@triton.jit(do_not_specialize=["num", "classes", "end"])
def _sort_keys_of_pairs(  # noqa: ANN202
    logits, keys, neighbours, table, sort_keys, num, classes, end,  # noqa: ANN001
    PEAKS: tl.constexpr, TAPS: tl.constexpr, WIDTH: tl.constexpr, BITS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """A block of pairs of one group."""
    place = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    group = tl.program_id(1)
    live = place < num * WIDTH
    row = place // WIDTH
    label = tl.load(table + group * WIDTH + place % WIDTH)
    seen = live & (label < classes)
    seen = seen & (tl.load(keys + row, mask=seen, other=0) < end)
    own = _score(logits + row * classes + label, seen)
    if PEAKS:
        peak = seen
        for tap in range(0, TAPS):
            other = tl.load(neighbours + tap * num + row, mask=seen, other=-1).to(tl.int64)
            peak = peak & (own >= _score(logits + other * classes + label, seen & (other >= 0)))
        own = tl.where(peak, own, 0.0)
    bits = own.to(tl.int32, bitcast=True).to(tl.int64)
    tl.store(sort_keys + group.to(tl.int64) * num * WIDTH + place, (bits << BITS) - place, mask=live)


@triton.jit(do_not_specialize=["num", "of_group", "classes"])
def _candidates_of_sort_keys(  # noqa: ANN202
    sort_keys, table, scores, rows, labels, num, of_group, classes,  # noqa: ANN001
    WIDTH: tl.constexpr, BITS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """A block of sort keys."""
    own = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = own < num
    key = tl.load(sort_keys + own, mask=live, other=0)
    place = -key & ((1 << BITS) - 1)
    score = ((key + place) >> BITS).to(tl.int32).to(tl.float32, bitcast=True)
    tl.store(scores + own, score, mask=live)
    tl.store(rows + own, place // WIDTH, mask=live)
    label = tl.load(table + (own // of_group) * WIDTH + place % WIDTH, mask=live, other=0)
    tl.store(labels + own, tl.minimum(label, classes - 1), mask=live)
