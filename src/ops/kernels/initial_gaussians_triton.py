"""The Gaussians that a frame starts from, by one Triton launch (method 4.4)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import triton
import triton.language as tl
from torch import Tensor

from src.ops.backend import runs_kernels
from src.ops.gaussian_shapes import LEAST_LENGTH, AttributeLimits
from src.ops.initial_gaussians import Attributes, Keypoints, Slots, initial_gaussians_reference


def initial_gaussians_triton(
    slots: Slots,
    keypoints: Sequence[Keypoints],
    history: Attributes | None,
    centre_m: Tensor,
    limits: AttributeLimits,
    batch_size: int,
) -> Attributes:
    """The reference's Gaussians up to rounding."""
    values = slots.values
    floats = [values, *(one.means for one in keypoints), *(history[:5] if history is not None else ())]
    if any(x.dtype != torch.float32 for x in floats) or not runs_kernels(values):
        return initial_gaussians_reference(slots, keypoints, history, centre_m, limits, batch_size)
    num, channels = len(values), slots.channels
    found = [one.valid.shape[1] for one in keypoints] or [0, 0]
    kept = 0 if history is None else history.valid.shape[1]
    size = (batch_size, num + kept)
    vectors, features = values.new_empty(4, *size, 2), values.new_empty(*size, channels)
    numbers, sources = values.new_empty(2, *size), slots.sources.new_empty(size)
    valid = values.new_empty(size, dtype=torch.uint8)
    if valid.numel() > 0:
        # Where there is nothing to read any tensor stands for it.
        read = [x for one in keypoints for x in (*_rows(one.means), one.valid.contiguous().view(torch.uint8))]
        changes = [one.change for one in keypoints if one.change is not None]
        past = [values] * 8 if history is None else [x.contiguous() for x in history[:-1]]
        past_valid = valid if history is None else history.valid.contiguous().view(torch.uint8)
        (low, high), unit = limits.scale_range_m, limits.velocity_unit_mps / limits.max_speed_mps
        with torch.cuda.device_of(values):
            _initialise[(valid.numel(),)](
                *(values, slots.sources, slots.learnt_means, slots.history_shift, centre_m),
                *(read or [values, 2, valid] * 2),
                *([x.contiguous() for x in changes] or [values] * 2),
                *(*past, past_valid, vectors, features, numbers, sources, valid),
                *(valid.numel(), num, kept, *found, channels),
                *(low, high - low, limits.max_speed_mps, unit, LEAST_LENGTH),
                CHANGED=len(changes) > 0,
                PAST=kept > 0,
                BLOCK=triton.next_power_of_2(channels),
                num_warps=1,
            )
    means, scales, directions, velocities = vectors.unbind(0)
    logits, ages = numbers.unbind(0)
    return Attributes(means, scales, directions, logits, velocities, features, sources, ages, valid.view(torch.bool))


def _rows(
    means: Tensor,  # [B, K, 2]
) -> tuple[Tensor, int]:
    """The means as rows one after the other, and the step from one to the next."""
    b, k, _ = means.shape
    regular = means.stride(2) == 1 and (b == 1 or means.stride(0) == k * means.stride(1))
    means = means if regular else means.contiguous()
    return means, means.stride(1)


@triton.jit(do_not_specialize=["all_rows", "num", "kept", "num_first", "num_second"])
def _initialise(  # noqa: ANN202
    values, own_sources, learnt, shift, centre,  # noqa: ANN001
    first, first_step, first_valid, second, second_step, second_valid, first_change, second_change,  # noqa: ANN001
    past_means, past_scales, past_directions, past_logits, past_velocities, past_features,  # noqa: ANN001
    past_sources, past_ages, past_valid,  # noqa: ANN001
    vectors, features, numbers, sources, valid,  # noqa: ANN001
    all_rows, num, kept, num_first, num_second, channels, low, span, max_speed, unit, least,  # noqa: ANN001
    CHANGED: tl.constexpr, PAST: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """One Gaussian. It is of one source, and what is read of all others is zero."""
    row = tl.program_id(0).to(tl.int64)
    sample, own = row // (num + kept), row % (num + kept)
    channel, axis = tl.arange(0, BLOCK), tl.arange(0, 2)
    wide = channel < channels
    is_slot, is_past = own < num, own >= num
    is_first = own < num_first
    is_second = (own >= num_first) & (own < num_first + num_second)
    is_learnt = is_slot & (own >= num_first + num_second)
    of_first, of_second = sample * num_first + own, sample * num_second + own - num_first
    of_learnt, of_past = own - num_first - num_second, sample * kept + own - num
    width = channels + 7

    mean = tl.load(first + of_first * first_step + axis, mask=is_first, other=0.0)
    mean += tl.load(second + of_second * second_step + axis, mask=is_second, other=0.0)
    there = tl.load(first_valid + of_first, mask=is_first, other=0)
    there += tl.load(second_valid + of_second, mask=is_second, other=0)
    there += is_learnt.to(tl.uint8)
    mean += tl.load(learnt + 2 * of_learnt + axis, mask=is_learnt, other=0.0)
    mean = tl.where(there > 0, mean, tl.load(centre + axis))

    feature = tl.load(values + own * width + channel, mask=is_slot & wide, other=0.0)
    raw = values + own * width + channels
    scale = tl.load(raw + axis, mask=is_slot, other=0.0)
    turn = tl.load(raw + 2 + axis, mask=is_slot, other=0.0)
    logit = tl.load(raw + 4, mask=is_slot, other=0.0)
    speed = tl.load(raw + 5 + axis, mask=is_slot, other=0.0)
    if CHANGED:
        feature += tl.load(first_change + of_first * width + channel, mask=is_first & wide, other=0.0)
        feature += tl.load(second_change + of_second * width + channel, mask=is_second & wide, other=0.0)
        raw = first_change + of_first * width + channels
        scale += tl.load(raw + axis, mask=is_first, other=0.0)
        turn += tl.load(raw + 2 + axis, mask=is_first, other=0.0)
        logit += tl.load(raw + 4, mask=is_first, other=0.0)
        speed += tl.load(raw + 5 + axis, mask=is_first, other=0.0)
        raw = second_change + of_second * width + channels
        scale += tl.load(raw + axis, mask=is_second, other=0.0)
        turn += tl.load(raw + 2 + axis, mask=is_second, other=0.0)
        logit += tl.load(raw + 4, mask=is_second, other=0.0)
        speed += tl.load(raw + 5 + axis, mask=is_second, other=0.0)
    scale = low + span / (1.0 + tl.exp(-scale))
    turn = turn / tl.maximum(tl.sqrt(tl.sum(turn * turn, 0)), least)
    speed = max_speed * (2.0 / (1.0 + tl.exp(-2.0 * unit * speed)) - 1.0)
    source = tl.load(own_sources + own, mask=is_slot, other=0)
    age = 0.0
    if PAST:
        pair = 2 * of_past + axis
        mean = tl.where(is_past, tl.load(past_means + pair, mask=is_past, other=0.0), mean)
        scale = tl.where(is_past, tl.load(past_scales + pair, mask=is_past, other=0.0), scale)
        turn = tl.where(is_past, tl.load(past_directions + pair, mask=is_past, other=0.0), turn)
        speed = tl.where(is_past, tl.load(past_velocities + pair, mask=is_past, other=0.0), speed)
        logit += tl.load(past_logits + of_past, mask=is_past, other=0.0)
        feature += tl.load(past_features + of_past * channels + channel, mask=is_past & wide, other=0.0).to(tl.float32)
        feature += tl.load(shift + channel, mask=is_past & wide, other=0.0)
        source += tl.load(past_sources + of_past, mask=is_past, other=0)
        age += tl.load(past_ages + of_past, mask=is_past, other=0.0)
        there += tl.load(past_valid + of_past, mask=is_past, other=0)

    spot = 2 * row + axis
    size = 2 * all_rows
    tl.store(vectors + spot, mean)
    tl.store(vectors + size + spot, scale)
    tl.store(vectors + 2 * size + spot, turn)
    tl.store(vectors + 3 * size + spot, speed)
    tl.store(features + row * channels + channel, feature, mask=wide)
    tl.store(numbers + row, logit)
    tl.store(numbers + all_rows + row, age)
    tl.store(sources + row, source)
    tl.store(valid + row, there)
