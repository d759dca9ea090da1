"""Splatting in Triton: the work per (Gaussian, cell) pair, forward by cell and backward by Gaussian (Eq. 4-6)."""

from __future__ import annotations

import math

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import FunctionCtx

from src.ops.backend import runs_kernels
from src.ops.gaussian_cells import GaussianCellPairs
from src.ops.splat import LEAST_SURPRISE, Choice, occupied_cells, occupied_places, splat_reference

# Cells a program sums the free probability of, one lane each.
CELLS = 128
# Pairs a program takes at a time: a cell meets few Gaussians, a Gaussian about a hundred cells.
PAIRS_OF_CELL = 8
PAIRS_OF_GAUSSIAN = 64
# Channels a program sums the features of one cell for, and values of a tile [pairs, channels] on the way back.
MOST_CHANNELS = 128
TILE = 4096
# Below this surprise u the free probability 1 - exp(-u) is taken from a series, since the difference would cancel.
LN2 = tl.constexpr(math.log(2.0))


def splat_triton(
    means: Tensor,
    scales: Tensor,
    directions: Tensor,
    opacity_logits: Tensor,
    features: Tensor,
    pairs: GaussianCellPairs,
    choice: Choice,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, int]:
    """The reference's results by three kernels over the pairs forward and one backward."""
    gaussians = (means, scales, directions, opacity_logits, features)
    if means.dtype != torch.float32 or not runs_kernels(means):
        return splat_reference(*gaussians, pairs, choice)
    return _Splat.apply(*gaussians, pairs, choice)


class _Splat(torch.autograd.Function):
    """S per support cell and F_G per occupied cell; all five gradients come from one walk over a Gaussian's pairs."""

    @staticmethod
    def forward(
        ctx: FunctionCtx,
        means: Tensor,
        scales: Tensor,
        directions: Tensor,
        opacity_logits: Tensor,
        features: Tensor,
        pairs: GaussianCellPairs,
        choice: Choice,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, int]:
        support, threshold, *limits = choice
        features, stride = features.contiguous(), opacity_logits.stride(0)
        with torch.cuda.device_of(means):
            log_free, occupied = means.new_empty(len(support)), support.new_empty(len(support), dtype=torch.uint8)
            if len(support) > 0:
                _log_free[(triton.cdiv(len(support), CELLS),)](
                    *(pairs.q, pairs.gaussian, opacity_logits, pairs.cell_starts, log_free, occupied),
                    *(len(support), stride, LEAST_SURPRISE, threshold),
                    BLOCK=CELLS,
                    num_warps=4,
                    enable_fp_fusion=True,
                )
            occupied_rows, num_cut = occupied_cells(occupied.view(torch.bool), log_free, support, *limits)
            if num_cut > 0:
                occupied = torch.zeros_like(occupied).index_fill(0, occupied_rows, 1)
            out = features.new_empty(len(occupied_rows), features.shape[1])
            if out.numel() > 0:
                width = min(triton.next_power_of_2(features.shape[1]), MOST_CHANNELS)
                _cell_features[(len(occupied_rows), triton.cdiv(features.shape[1], width))](
                    *(pairs.q, pairs.gaussian, features, pairs.cell_starts, occupied_rows, out),
                    features.shape[1],
                    BLOCK_PAIRS=PAIRS_OF_CELL,
                    BLOCK_CHANNELS=width,
                    num_warps=1,
                    enable_fp_fusion=True,
                )
            peak_cell, contribution = support.new_empty(len(means)), means.new_empty(len(means))
            if len(means) > 0:
                _nearest_cell[(len(means),)](
                    *(pairs.q, pairs.cell, pairs.by_gaussian, pairs.gaussian_starts, occupied, support),
                    *(opacity_logits, peak_cell, contribution, stride),
                    BLOCK=PAIRS_OF_GAUSSIAN,
                    num_warps=1,
                    enable_fp_fusion=True,
                )
        ctx.save_for_backward(scales, directions, opacity_logits, features, occupied_rows, support)
        ctx.pairs = pairs
        ctx.mark_non_differentiable(occupied_rows, peak_cell, contribution)
        return log_free, out, occupied_rows, peak_cell, contribution, num_cut

    @staticmethod
    def backward(ctx: FunctionCtx, grad_log_free: Tensor, grad_out: Tensor, *_: None) -> tuple[Tensor | None, ...]:
        scales, directions, opacity_logits, features, occupied_rows, support = ctx.saved_tensors
        pairs: GaussianCellPairs = ctx.pairs
        place = occupied_places(occupied_rows, support)
        shape_grad = features.new_zeros(len(features), 7)  # means, scales, directions, logits
        grad_features = torch.zeros_like(features)
        if len(pairs.q) > 0:
            width = max(triton.next_power_of_2(features.shape[1]), 1)
            with torch.cuda.device_of(features):
                _gaussian_gradient[(len(features),)](
                    *(pairs.q, pairs.delta, pairs.cell, pairs.by_gaussian, pairs.gaussian_starts, place),
                    *(scales.contiguous(), directions.contiguous(), opacity_logits, features),
                    *(grad_log_free.contiguous(), grad_out.contiguous(), shape_grad, grad_features),
                    *(features.shape[1], opacity_logits.stride(0), LEAST_SURPRISE),
                    BLOCK_PAIRS=min(max(TILE // width, 2), PAIRS_OF_GAUSSIAN),
                    BLOCK_CHANNELS=width,
                    num_warps=8,
                    enable_fp_fusion=True,
                )
        means_grad, scales_grad, directions_grad, logits_grad = shape_grad.split((2, 2, 2, 1), 1)
        return means_grad, scales_grad, directions_grad, logits_grad.squeeze(1), grad_features, None, None


@triton.jit
def _free(surprise):  # noqa: ANN001, ANN202
    """1 - a = 1 - exp(-u), with full relative precision also where a is near one."""
    u = tl.minimum(surprise, LN2)
    series = 1.0 - u / 9.0
    series = 1.0 - u / 8.0 * series
    series = 1.0 - u / 7.0 * series
    series = 1.0 - u / 6.0 * series
    series = 1.0 - u / 5.0 * series
    series = 1.0 - u / 4.0 * series
    series = 1.0 - u / 3.0 * series
    series = 1.0 - u / 2.0 * series
    return tl.where(surprise < LN2, u * series, 1.0 - tl.exp(-surprise))


@triton.jit
def _log_of_free(surprise):  # noqa: ANN001, ANN202
    """log(1 - exp(-u)) without cancellation on either side."""
    # Where a is below 1/2: log(1 - a) = -2 artanh(a / (2 - a)), whose series needs no difference of near numbers.
    a = tl.minimum(tl.exp(-surprise), 0.5)
    return tl.where(surprise < LN2, tl.log(_free(surprise)), -_twice_artanh(a / (2.0 - a)))


@triton.jit
def _twice_artanh(t):  # noqa: ANN001, ANN202
    """2 artanh(t) for t from 0 to 1/3."""
    s = t * t
    return 2.0 * t * (1.0 + s * (1.0 / 3 + s * (1.0 / 5 + s * (1.0 / 7 + s * (1.0 / 9 + s * (1.0 / 11 + s / 13))))))


@triton.jit
def _surprise(logit):  # noqa: ANN001, ANN202
    """-log sigmoid(o) = max(-o, 0) + log(1 + exp(-|o|)), to the last digit where it is small."""
    e = tl.exp(-tl.abs(logit))
    return tl.maximum(-logit, 0.0) + _twice_artanh(e / (2.0 + e))


@triton.jit
def _log_free(  # noqa: ANN202
    q, gaussian, logits, starts, out, occupied, num, stride, least, threshold,  # noqa: ANN001
    BLOCK: tl.constexpr,
):  # fmt: skip
    """S = sum of log(1 - a) per cell (Eq. 5), and whether alpha is above the threshold: a lane a cell, pair by pair."""
    cell = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = cell < num
    first = tl.load(starts + cell, mask=live, other=0).to(tl.int32)
    size = tl.load(starts + cell + 1, mask=live, other=0).to(tl.int32) - first
    total = tl.zeros((BLOCK,), tl.float32)
    for step in range(0, tl.max(size, 0)):
        inside = step < size
        owner = tl.load(gaussian + first + step, mask=inside, other=0)
        own = _surprise(tl.load(logits + stride * owner, mask=inside, other=0.0))
        own += 0.5 * tl.load(q + first + step, mask=inside, other=0.0)
        total += tl.where(inside, _log_of_free(tl.maximum(own, least)), 0.0)
    tl.store(out + cell, total, mask=live)
    tl.store(occupied + cell, (_free(-total) > threshold).to(tl.uint8), mask=live)


@triton.jit
def _cell_features(  # noqa: ANN202
    q, gaussian, features, starts, rows, out, channels,  # noqa: ANN001
    BLOCK_PAIRS: tl.constexpr, BLOCK_CHANNELS: tl.constexpr,
):  # fmt: skip
    """F_G = sum of k_i f_i at one occupied cell (Eq. 6)."""
    place = tl.program_id(0).to(tl.int64)
    channel = tl.program_id(1) * BLOCK_CHANNELS + tl.arange(0, BLOCK_CHANNELS)
    lane = tl.arange(0, BLOCK_PAIRS)
    row = tl.load(rows + place)
    last = tl.load(starts + row + 1).to(tl.int32)
    total = tl.zeros((BLOCK_CHANNELS,), tl.float32)
    for first in range(tl.load(starts + row).to(tl.int32), last, BLOCK_PAIRS):
        live = first + lane < last
        owner = tl.load(gaussian + first + lane, mask=live, other=0).to(tl.int64)
        kernel = tl.exp(-0.5 * tl.load(q + first + lane, mask=live, other=0.0))
        values = tl.load(
            features + owner[:, None] * channels + channel[None, :],
            mask=live[:, None] & (channel[None, :] < channels),
            other=0.0,
        )
        total += tl.sum(kernel[:, None] * values, 0)
    tl.store(out + place * channels + channel, total, mask=channel < channels)


@triton.jit
def _nearest_cell(  # noqa: ANN202
    q, cell, by_gaussian, starts, occupied, support, logits, peak, contribution, stride,  # noqa: ANN001
    BLOCK: tl.constexpr,
):  # fmt: skip
    """The occupied cell with the smallest q of one Gaussian, the first on ties, -1 for none, and a_i there."""
    gaussian = tl.program_id(0)
    lane = tl.arange(0, BLOCK)
    last = tl.load(starts + gaussian + 1).to(tl.int32)
    least = float("inf")
    where = tl.full((), -1, tl.int64)
    for first in range(tl.load(starts + gaussian).to(tl.int32), last, BLOCK):
        live = first + lane < last
        pair = tl.load(by_gaussian + first + lane, mask=live, other=0)
        row = tl.load(cell + pair, mask=live, other=0)
        live = live & (tl.load(occupied + row, mask=live, other=0) > 0)
        distance = tl.load(q + pair, mask=live, other=float("inf"))
        nearest = tl.min(distance, 0)
        key = tl.min(tl.where(live & (distance == nearest), row, 2**31 - 1), 0)
        where = tl.where(nearest < least, key, where)
        least = tl.minimum(nearest, least)
    tl.store(peak + gaussian, tl.load(support + where, mask=where >= 0, other=-1))
    tl.store(contribution + gaussian, tl.exp(-0.5 * least) / (1.0 + tl.exp(-tl.load(logits + stride * gaussian))))


@triton.jit
def _gaussian_gradient(  # noqa: ANN202
    q, delta, cell, by_gaussian, starts, place,  # noqa: ANN001
    scales, directions, logits, features,  # noqa: ANN001
    grad_log_free, grad_out, shape_grad, grad_features,  # noqa: ANN001
    channels, stride, least,  # noqa: ANN001
    BLOCK_PAIRS: tl.constexpr, BLOCK_CHANNELS: tl.constexpr,
):  # fmt: skip
    """All gradients of one Gaussian, in closed form (method 5.6)."""
    gaussian = tl.program_id(0).to(tl.int64)
    channel = tl.arange(0, BLOCK_CHANNELS)
    wide = channel < channels
    lane = tl.arange(0, BLOCK_PAIRS)
    size_x, size_y = tl.load(scales + gaussian * 2), tl.load(scales + gaussian * 2 + 1)
    cosine, sine = tl.load(directions + gaussian * 2), tl.load(directions + gaussian * 2 + 1)
    logit = tl.load(logits + stride * gaussian)
    base = _surprise(logit)
    own = tl.load(features + gaussian * channels + channel, mask=wide, other=0.0)

    zero = tl.zeros((BLOCK_PAIRS,), tl.float32)
    by_logit, by_x, by_y, by_size_x, by_size_y, by_cosine, by_sine = zero, zero, zero, zero, zero, zero, zero
    by_feature = tl.zeros((BLOCK_CHANNELS,), tl.float32)
    last = tl.load(starts + gaussian + 1).to(tl.int32)
    for first in range(tl.load(starts + gaussian).to(tl.int32), last, BLOCK_PAIRS):
        live = first + lane < last
        pair = tl.load(by_gaussian + first + lane, mask=live, other=0)
        row = tl.load(cell + pair, mask=live, other=0)
        distance = tl.load(q + pair, mask=live, other=0.0)
        # Through S: d log(1 - a) / d(-log a) = a / (1 - a), nothing where the cap binds.
        u = tl.maximum(base + 0.5 * distance, least)
        slope = tl.load(grad_log_free + row, mask=live, other=0.0) * tl.exp(-u) / _free(tl.where(live, u, 1.0))
        slope = tl.where(live & (u > least), slope, 0.0)
        by_logit += slope
        # Through F_G = sum of k f, k = exp(-q / 2), at the occupied cells.
        kernel = tl.exp(-0.5 * distance)
        spot = tl.load(place + row, mask=live, other=-1)
        pull = tl.load(
            grad_out + spot[:, None] * channels + channel[None, :],
            mask=(spot[:, None] >= 0) & wide[None, :],
            other=0.0,
        )
        by_feature += tl.sum(kernel[:, None] * pull, 0)
        by_distance = 0.5 * (slope - kernel * tl.sum(pull * own[None, :], 1))

        delta_x = tl.load(delta + pair * 2, mask=live, other=0.0)
        delta_y = tl.load(delta + pair * 2 + 1, mask=live, other=0.0)
        along, across = cosine * delta_x + sine * delta_y, cosine * delta_y - sine * delta_x
        push_x = 2 * by_distance * along / (size_x * size_x)
        push_y = 2 * by_distance * across / (size_y * size_y)
        by_x += push_x
        by_y += push_y
        by_size_x += push_x * along
        by_size_y += push_y * across
        by_cosine += push_x * delta_x + push_y * delta_y
        by_sine += push_x * delta_y - push_y * delta_x

    tl.store(grad_features + gaussian * channels + channel, by_feature, mask=wide)
    to_x, to_y = tl.sum(by_x, 0), tl.sum(by_y, 0)
    out = shape_grad + gaussian * 7
    tl.store(out, sine * to_y - cosine * to_x)
    tl.store(out + 1, -sine * to_x - cosine * to_y)
    tl.store(out + 2, -tl.sum(by_size_x, 0) / size_x)
    tl.store(out + 3, -tl.sum(by_size_y, 0) / size_y)
    tl.store(out + 4, tl.sum(by_cosine, 0))
    tl.store(out + 5, tl.sum(by_sine, 0))
    faint = 1.0 / (1.0 + tl.exp(logit))  # sigmoid(-o)
    tl.store(out + 6, -tl.sum(by_logit, 0) * faint)
