"""Segment reduce, gather and scatter of rows, per-sample top-k: deterministic, without a tensor of one row per pair.

Pairs name rows of some values and the segment each goes to; a segment is a run of pairs.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import FunctionCtx

from src.geometry.constants import arange, constant, where_scalar
from src.ops.backend import implementation
from src.ops.distinct_keys import Groups
from src.ops.fixed_shapes import fixed_shapes

# Pairs multiplied at a time in `paired_dot`: cache-sized on a CPU, few launches on a GPU.
CPU_CHUNK = 2048
GPU_CHUNK = 65536


def segments(
    rows: Tensor,  # [pairs] integer
    num_rows: int,
) -> tuple[Tensor, Tensor]:
    """Stable order of the pairs by row [pairs], and the start of each row's segment [num_rows + 1], int32."""
    ordered, order = torch.sort(rows, stable=True)
    edges = arange(num_rows + 1, rows.dtype, rows.device)
    return order.to(torch.int32), torch.searchsorted(ordered, edges, out_int32=True)


def gather_segment_sum(
    values: Tensor,  # [n, C]
    picks: Tensor,  # [pairs] integer, rows of `values`, segment by segment
    starts: Tensor,  # [segments + 1], same type: first pair of each segment
    weights: Tensor | None = None,  # [pairs]
) -> Tensor:  # [segments, C]
    """Gather the picked rows and sum them, weighted, by segment; 0 for an empty segment. Without gradient."""
    if len(picks) == 0:
        return values.new_zeros(len(starts) - 1, values.shape[1])
    return F.embedding_bag(picks, values, starts, mode="sum", include_last_offset=True, per_sample_weights=weights)


def segment_count(
    rows: Tensor,  # [n] int64
    num_rows: int,
    groups: Groups | None = None,  # of the rows, where the caller knows them
) -> Tensor:  # [num_rows] int64
    """How many values share each row. Does not wait for a GPU, as bincount does."""
    if groups is not None:
        return groups.starts.diff()
    if rows.device.type == "cpu":  # where it is faster
        return torch.bincount(rows, minlength=num_rows)
    return rows.new_zeros(num_rows).index_add_(0, rows, constant((1,), rows.dtype, rows.device).expand_as(rows))


def segment_sum(
    values: Tensor,  # [n, C]
    rows: Tensor,  # [n] int64
    num_rows: int,
    groups: Groups | None = None,  # of the rows, where the caller knows them
) -> Tensor:  # [num_rows, C]
    """Scatter sum: values that share a row, added in their order of appearance; absent rows are 0. Differentiable,
    unless groups are given."""
    if groups is not None:
        return group_sum(values, groups)
    return _SegmentSum.apply(values, rows, num_rows)


def segment_mean(
    values: Tensor,  # [n, C]
    rows: Tensor,  # [n] int64
    num_rows: int,
    groups: Groups | None = None,  # of the rows, where the caller knows them
) -> Tensor:  # [num_rows, C]
    """Scatter mean: values that share a row; absent rows are 0. Differentiable, unless groups are given."""
    if groups is not None:
        return group_sum(values, groups, mean=True)
    counts = segment_count(rows, num_rows)
    return segment_sum(values, rows, num_rows) / counts.clamp(min=1)[:, None].to(values.dtype)


@torch.no_grad()
def group_sum(
    values: Tensor,  # [n, C]
    groups: Groups,  # of rows of `values`; it may name others that are in no group
    mean: bool = False,
) -> Tensor:  # [groups, C]
    """Sum or mean of the rows of each group in their order; 0 for an empty one."""
    return implementation(group_sum_reference)(values, groups, mean)


def group_sum_reference(values: Tensor, groups: Groups, mean: bool) -> Tensor:
    """Plain torch form. Waits for a GPU."""
    members, mode = groups.order[: int(groups.starts[-1])], "mean" if mean else "sum"
    if len(members) == 0:
        return values.new_zeros(len(groups.starts) - 1, values.shape[1])
    return F.embedding_bag(members, values, groups.starts, mode=mode, include_last_offset=True)


def segment_max(
    values: Tensor,  # [n, C]
    rows: Tensor,  # [n] int64
    num_rows: int,
) -> Tensor:  # [num_rows, C]
    """Scatter maximum: of the values that share a row; absent rows are 0. Differentiable."""
    index = rows[:, None].expand_as(values)
    zeros = values.new_zeros(num_rows, values.shape[1])
    return zeros.scatter_reduce(0, index, values, "amax", include_self=False)


def segment_softmax(
    scores: Tensor,  # [n]
    rows: Tensor,  # [n] int64
    num_rows: int,
) -> Tensor:  # [n]
    """Softmax over the scores that share a row. Differentiable."""
    with torch.no_grad():  # softmax does not change with what is subtracted
        highest = scores.new_zeros(num_rows).scatter_reduce(0, rows, scores, "amax", include_self=False)
    weights = (scores - highest[rows]).exp()
    return weights / F.embedding(rows, segment_sum(weights[:, None], rows, num_rows)).squeeze(1)


class _SegmentSum(torch.autograd.Function):
    @staticmethod
    def forward(ctx: FunctionCtx, values: Tensor, rows: Tensor, num_rows: int) -> Tensor:
        ctx.save_for_backward(rows)
        return gather_segment_sum(values, *segments(rows, num_rows))

    @staticmethod
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor, None, None]:
        (rows,) = ctx.saved_tensors
        return F.embedding(rows, grad.contiguous()), None, None


def permute_rows(
    values: Tensor,  # [n, C]
    there: Tensor,  # [m] integer, the row of `values` that each result takes, -1 for zeros; none twice
    back: Tensor,  # [n] integer, the inverse: the result that takes each row, -1 for none
) -> Tensor:  # [m, C]
    """Permute, insert and drop rows. Differentiable; the backward pass is a gather as well, so nothing is summed."""
    return _PermuteRows.apply(values, there, back)


class _PermuteRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx: FunctionCtx, values: Tensor, there: Tensor, back: Tensor) -> Tensor:
        ctx.save_for_backward(back)
        return gather_rows(values, there)

    @staticmethod
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor, None, None]:
        (back,) = ctx.saved_tensors
        return gather_rows(grad, back), None, None


@torch.no_grad()
def gather_rows(
    values: Tensor,  # [n, C]
    rows: Tensor,  # [m] integer, -1 for zeros
) -> Tensor:  # [m, C]
    """Gather rows, without gradient."""
    return implementation(gather_rows_reference)(values, rows)


def gather_rows_reference(values: Tensor, rows: Tensor) -> Tensor:
    """Plain torch form."""
    padded = F.pad(values, (0, 0, 1, 0))  # -1 takes the row of zeros before them: a mask over rows takes twice as long
    return padded.index_select(0, rows + 1)


def topk_per_sample(
    scores: Tensor,  # [M]
    sample: Tensor,  # [M] int64; `batch_size` for padding
    batch_size: int,
    count: int,
) -> Tensor:  # [B, count] int64
    """Rows of the highest scores of each sample, best first, ties by row; -1 where a sample has fewer."""
    if fixed_shapes() is not None and batch_size == 1:
        best, order = where_scalar(sample < 1, scores, -torch.inf).sort(descending=True, stable=True)
        found = where_scalar(best[:count] > -torch.inf, order[:count], -1)
        return F.pad(found, (0, count - len(found)), value=-1)[None] if len(found) < count else found[None]
    order, rank = rank_per_sample(scores, sample)
    rows = order.new_full((batch_size + 1, count + 1), -1)
    rows[sample[order], rank.clamp(max=count)] = order  # all beyond the last place meet in one column that is dropped
    return rows[:batch_size, :count]


def rank_per_sample(
    scores: Tensor,  # [M]
    sample: Tensor,  # [M] int64
) -> tuple[Tensor, Tensor]:  # [M], [M] int64
    """Rows sample by sample, best first, ties by row, and the rank 0, 1, ... of each within its sample."""
    order = scores.argsort(descending=True, stable=True)
    order = order[sample[order].argsort(stable=True)]
    owner = sample[order]
    return order, arange(len(order), torch.int64, order.device) - torch.searchsorted(owner, owner)


def inverse_rows(
    rows: Tensor,  # [m] int64, distinct, each below `num`
    num: int,
) -> Tensor:  # [num] int64
    """Place of each of `num` rows among the given ones, -1 where it is absent: the inverse permutation of all rows."""
    places = rows.new_full((num,), -1)
    places[rows] = arange(len(rows), torch.int64, rows.device)
    return places


def weighted_segment_sum(
    values: Tensor,  # [n, C]
    weights: Tensor,  # [pairs]
    picks: Tensor,  # [pairs] integer, row of `values`
    segment: Tensor,  # [pairs] int64, ascending
    num_segments: int,
    by_pick: Tensor | None = None,  # [pairs] int64, the pairs ordered by `picks`, where the caller knows it
) -> Tensor:  # [num_segments, C]
    """Gather, weight and segment sum, differentiable in the values and in the weights."""
    return _WeightedSegmentSum.apply(values, weights, picks, segment, num_segments, by_pick)


class _WeightedSegmentSum(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: FunctionCtx,
        values: Tensor,
        weights: Tensor,
        picks: Tensor,
        segment: Tensor,
        num_segments: int,
        by_pick: Tensor | None,
    ) -> Tensor:
        ctx.save_for_backward(values, weights, picks, segment)
        ctx.by_pick = by_pick
        return gather_segment_sum(values, picks, _starts(segment, num_segments), weights)

    @staticmethod
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor | None, Tensor | None, None, None, None, None]:
        values, weights, picks, segment = ctx.saved_tensors
        grad = grad.contiguous()
        grad_values = grad_weights = None
        if ctx.needs_input_grad[0]:
            order = torch.argsort(picks, stable=True) if ctx.by_pick is None else ctx.by_pick
            back, turned = segment.index_select(0, order), weights.index_select(0, order)
            grad_values = gather_segment_sum(grad, back, _starts(picks, len(values)), turned)
        if ctx.needs_input_grad[1]:
            grad_weights = paired_dot(grad, segment, values, picks)
        return grad_values, grad_weights, None, None, None, None


def paired_dot(
    a: Tensor,  # [n, C]
    rows_a: Tensor,  # [pairs]
    b: Tensor,  # [m, C]
    rows_b: Tensor,  # [pairs]
) -> Tensor:  # [pairs]
    """Scalar products of paired rows, a chunk of pairs at a time."""
    out = a.new_empty(len(rows_a))
    chunk = CPU_CHUNK if a.device.type == "cpu" else GPU_CHUNK
    for start in range(0, len(rows_a), chunk):
        span = slice(start, start + chunk)
        out[span] = (F.embedding(rows_a[span], a) * F.embedding(rows_b[span], b)).sum(1)
    return out


def _starts(
    rows: Tensor,  # [pairs] int64, any order
    num_rows: int,
) -> Tensor:  # [num_rows + 1] int64
    """Where each row's pairs begin once the pairs are ordered by row."""
    return F.pad(segment_count(rows, num_rows).cumsum(0), (1, 0))
