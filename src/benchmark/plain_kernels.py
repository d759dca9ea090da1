"""The plain form of every Triton kernel, under its name and with its arguments; each fills the kernel's outputs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.geometry.box_cells import window_corners
from src.ops.add_layer_norm import add_layer_norm_reference, relu_norm_columns_reference
from src.ops.box_codes import decoded_boxes_reference
from src.ops.candidate_sort_keys import sort_keys_of_scores, unpack_candidates_reference
from src.ops.cell_keys import cell_centres_reference, cell_keys_reference
from src.ops.deform_sample import attend_cells_reference, attend_views_reference
from src.ops.distinct_keys import Groups, distinct_keys_reference, grouped_keys_reference
from src.ops.farthest_point import farthest_points_reference
from src.ops.frame_motion import relative_motion_reference, warp_gaussians_reference
from src.ops.gather_cells import gather_cells_reference
from src.ops.gaussian_cells import cell_distances, gaussian_windows
from src.ops.gaussian_shapes import AttributeLimits, refined_attributes_reference, sampling_points_reference
from src.ops.initial_gaussians import Attributes, Keypoints, Slots, initial_gaussians_reference
from src.ops.moved_keys import moved_keys_reference
from src.ops.neighbour_table import neighbour_table_reference, stacked_table_reference, transposed_table_reference
from src.ops.radial_correction import radial_correction_reference, radial_votes_reference
from src.ops.score_and_lift_pixels import score_and_lift_pixels_reference
from src.ops.segment_reduce import gather_rows_reference, group_sum_reference
from src.ops.sites import HALO
from src.ops.splat import log1mexp
from src.ops.view_samples import view_attention_weights_reference, view_sampling_locations_reference

KERNELS: dict[str, Callable[..., None] | None] = {"_span_product": None, "_gaussian_gradient": None}
"""Plain torch form of each Triton kernel by its name; None where a kernel's values are a gradient."""


def _of_kernel(function: Callable[..., None]) -> Callable[..., None]:
    """Register a function in KERNELS as the plain form of the kernel of its name."""
    KERNELS[function.__name__] = function
    return function


@_of_kernel
def _sample(points: Tensor, valid: Tensor, start: Tensor, picks: Tensor, num: int, count: int) -> None:
    picks.copy_(farthest_points_reference(points, valid.bool(), start, count))


@_of_kernel
def _search(
    keys: Tensor, corners: Tensor, taps: Tensor, table: Tensor, bits: Tensor, plan: Tensor, shifts: Tensor, *sizes: int
) -> None:
    if plan is not keys:
        axes = tuple(map(tuple, plan.tolist()))
        corners = moved_keys_reference(corners, sizes[-2:], axes, (tuple(shifts.tolist()),))[0]
    for out, found in zip((table, bits), neighbour_table_reference(keys, corners, taps), strict=True):
        out.copy_(found)


@_of_kernel
def _stack(table: Tensor, own: Tensor, other: Tensor, out: Tensor, bits: Tensor, first: int, *sizes: int) -> None:
    for filled, found in zip((out, bits), stacked_table_reference(table, (own, other), first), strict=True):
        filled.copy_(found)


@_of_kernel
def _turn(table: Tensor, back: Tensor, bits: Tensor, num: int, cells: int) -> None:
    for out, found in zip((back, bits), transposed_table_reference(table, num), strict=True):
        out.copy_(found)


@_of_kernel
def _locate(
    points: Tensor, samples: Tensor, valid: Tensor, frame: Tensor, limits: Tensor, out: Tensor, *rest: int
) -> None:
    num, total, _, _, step, end = rest
    checked = None if valid is points else valid > 0
    lower, size = (tuple(row) for row in frame.tolist())
    shape = (end // step, *limits[:, 0].flip(0).tolist())
    out.copy_(cell_keys_reference(points, samples, checked, lower, size, shape, frame.dtype, total - num))


@_of_kernel
def _centre(
    keys: Tensor, out: Tensor, num: int, sample_step: int, row_step: int, x_min: float, y_min: float, cell_m: float
) -> None:
    grid = _grid(sample_step // row_step - HALO, row_step - HALO, x_min, y_min, cell_m)
    out.copy_(cell_centres_reference(keys, grid))


@_of_kernel
def _count_firsts(ordered: Tensor, counts: Tensor, num: int, end: int, blocks: int) -> None:
    counts.zero_()


@_of_kernel
def _write_groups(
    ordered: Tensor, order: Tensor, counts: Tensor, found: Tensor, rows: Tensor, starts: Tensor, num: int, size: int,
    end: int, blocks: int,
) -> None:  # fmt: skip
    if starts is found:
        found.copy_(distinct_keys_reference(ordered, end, size))
        return
    keys, own, groups = grouped_keys_reference(ordered, end, size)
    found.copy_(keys)
    starts.copy_(groups.starts)
    rows[order] = own


@_of_kernel
def _sum_groups(
    values: Tensor, order: Tensor, starts: Tensor, out: Tensor, num: int, channels: int, mean: bool
) -> None:
    out.copy_(group_sum_reference(values, Groups(order, starts), mean))


@_of_kernel
def _take(values: Tensor, rows: Tensor, out: Tensor, *sizes: int) -> None:
    out.copy_(gather_rows_reference(values, rows))


@_of_kernel
def _move(keys: Tensor, plan: Tensor, taps: Tensor, out: Tensor, num: int, old_step: int, new_step: int) -> None:
    axes, shifts = (tuple(map(tuple, rows.tolist())) for rows in (plan, taps))
    out.copy_(moved_keys_reference(keys, (old_step, new_step), axes, shifts))


@_of_kernel
def _vote(points: Tensor, batch: Tensor, keys: Tensor, weighted: Tensor, num: int, width: int, *rest: float) -> None:
    for out, values in zip((keys, weighted), radial_votes_reference(points, batch, _grid(*rest[:5])), strict=True):
        out.copy_(values)


@_of_kernel
def _nearest_radial(
    velocities: Tensor, cells: Tensor, keys: Tensor, measured: Tensor, out: Tensor, *rest: float
) -> None:
    out.copy_(radial_correction_reference(velocities, cells, keys, measured, _grid(*rest[3:8]), rest[-1]))


@_of_kernel
def _decode(
    codes: Tensor, rows: Tensor, indices: Tensor, labels: Tensor, scores: Tensor, rules: Tensor, keys: Tensor,
    measured: Tensor, out: Tensor, num: int, width: int, classes: int, keys_num: int, steps: int, *rest: float,
    MEASURED: bool, TURNED: bool,
) -> None:  # fmt: skip
    radar = (keys, measured) if MEASURED else None
    table = tuple(map(tuple, rules.tolist()))
    out.copy_(
        decoded_boxes_reference(codes, rows, indices, labels, scores, rest[5], _grid(*rest[:5]), table, radar, TURNED)
    )


@_of_kernel
def _relate(
    now: Tensor, now_s: Tensor, aug: Tensor, poses: Tensor, times: Tensor, present: Tensor, matrix: Tensor,
    elapsed: Tensor, flags: Tensor, *sizes: int, NEWEST: bool, MAX_AGE: float, MAX_SPEED: float,
) -> None:  # fmt: skip
    there = present.view(times.shape) > 0
    found = relative_motion_reference((now, now_s), aug, (poses, times), there, MAX_AGE, MAX_SPEED, NEWEST)
    for out, values in zip((flags[0], matrix, elapsed, flags[1]), found, strict=True):
        out.copy_(values.view(out.shape))


@_of_kernel
def _move_gaussians(
    means: Tensor, scales: Tensor, turns: Tensor, speeds: Tensor, valid: Tensor, matrices: Tensor, elapsed: Tensor,
    usable: Tensor, out: Tensor, moved: Tensor, *rest: float, DRIVEN: bool,
) -> None:  # fmt: skip
    shapes = tuple(x.view(*valid.shape, 2) for x in (means, scales, turns, speeds))
    least = rest[-1] if DRIVEN else None
    found = warp_gaussians_reference(shapes, valid > 0, matrices, elapsed, usable > 0, least, _grid(*rest[6:11]))
    out.copy_(torch.stack(found[0]))
    moved.copy_(found[1])


@_of_kernel
def _sum_norm(
    x: Tensor, added: Tensor, scale: Tensor, shift: Tensor, then: Tensor, embedded: Tensor, ages: Tensor, out: Tensor,
    behind: Tensor, num: int, channels: int, own: int, columns: int, eps: float, *, ADDED: bool, RELU_FIRST: bool,
    RELU_LAST: bool, THEN: bool, AGED: bool,
) -> None:  # fmt: skip
    if RELU_FIRST:
        out.copy_(relu_norm_columns_reference(x.clone(), eps))
        return
    rest = (added if ADDED else None, RELU_LAST, then if THEN else None, (embedded, ages) if AGED else None)
    normed, more = add_layer_norm_reference(x, (scale, shift), eps, *rest)
    out.copy_(normed)
    if more is not None:
        behind.copy_(more)


@_of_kernel
def _sort_keys_of_pairs(
    logits: Tensor, keys: Tensor, neighbours: Tensor, table: Tensor, sort_keys: Tensor, num: int, classes: int,
    end: int, *, PEAKS: bool,
) -> None:  # fmt: skip
    scores = logits.sigmoid()
    if PEAKS:
        others = F.pad(scores, (0, 0, 1, 0), value=-torch.inf)[neighbours.long() + 1]  # [9, M, classes]
        scores = scores * (scores == others.amax(0))
    scores = scores.where((keys < end)[:, None], 0.0)
    sort_keys.copy_(sort_keys_of_scores(scores, tuple(map(tuple, table.tolist()))))


@_of_kernel
def _candidates_of_sort_keys(
    sort_keys: Tensor,
    table: Tensor,
    scores: Tensor,
    rows: Tensor,
    labels: Tensor,
    num: int,
    of_group: int,
    classes: int,
) -> None:
    found = unpack_candidates_reference(sort_keys, tuple(map(tuple, table.tolist())), classes)
    for out, values in zip((scores, rows, labels), found, strict=True):
        out.copy_(values)


@_of_kernel
def _attend_cells(
    values: Tensor, table: Tensor, points: Tensor, batch: Tensor, weights: Tensor, out: Tensor, *rest: float
) -> None:
    out.copy_(attend_cells_reference(values, table, points, batch, weights, _grid(*rest[3:8])))


@_of_kernel
def _attend_level(
    image: Tensor, places: Tensor, weights: Tensor, out: Tensor, level: int, levels: int, *sizes: int
) -> None:
    if level == 0:
        out.zero_()
    out += attend_views_reference([image], places, weights[:, :, :, :, level : level + 1])


@_of_kernel
def _place(
    points: Tensor, heights: Tensor, matrices: Tensor, valid: Tensor, places: Tensor, visible: Tensor, *rest: float
) -> None:
    low, span, height, width = rest[4:8]
    found = view_sampling_locations_reference(points, heights, (low, low + span), matrices, valid > 0, (height, width))
    for out, values in zip((places, visible), found, strict=True):
        out.copy_(values)


@_of_kernel
def _weigh(logits: Tensor, camera: Tensor, visible: Tensor, out: Tensor, *sizes: int) -> None:
    out.copy_(view_attention_weights_reference(logits, camera, visible > 0, sizes[2]))


@_of_kernel
def _spread(
    offsets: Tensor, fixed: Tensor, means: Tensor, scales: Tensor, directions: Tensor, out: Tensor, *rest: float
) -> None:
    out.copy_(sampling_points_reference(offsets, fixed, means, scales, directions))


@_of_kernel
def _refine(
    raw: Tensor, means: Tensor, lower: Tensor, upper: Tensor, out: Tensor, num: int, low: float, span: float,
    max_shift: float, max_speed: float, unit: float, least: float,
) -> None:  # fmt: skip
    limits = AttributeLimits((low, low + span), max_shift, max_speed, unit * max_speed)
    out.copy_(torch.stack(refined_attributes_reference(raw, means, lower, upper, limits)))


@_of_kernel
def _initialise(
    values: Tensor, sources: Tensor, learnt: Tensor, shift: Tensor, centre: Tensor, first: Tensor, first_step: int,
    first_valid: Tensor, second: Tensor, second_step: int, second_valid: Tensor, first_change: Tensor,
    second_change: Tensor, *rest: Any,
) -> None:  # fmt: skip
    *past, past_valid = rest[:9]
    all_rows, num, kept, num_first, _, _, low, span, max_speed, unit, _ = rest[14:]
    found = [(first, first_valid, first_change), (second, second_valid, second_change)] if num_first > 0 else []
    keypoints = [Keypoints(x, valid > 0, change if change.dim() == 3 else None) for x, valid, change in found]
    limits = AttributeLimits((low, low + span), 0.0, max_speed, unit * max_speed)
    slots, history = Slots(values, sources, learnt, shift), Attributes(*past, past_valid > 0) if kept > 0 else None
    batch_size = all_rows // (num + kept)
    wanted = initial_gaussians_reference(slots, keypoints, history, centre, limits, batch_size)
    means, scales, directions, logits, velocities, features, sources, ages, valid = wanted
    made = (torch.stack([means, scales, directions, velocities]), features, torch.stack([logits, ages]), sources, valid)
    for out, own in zip(rest[9:14], made, strict=True):
        out.copy_(own)


@_of_kernel
def _score(
    keypoints: Tensor, depths: Tensor, centres: Tensor, matrices: Tensor, valid: Tensor, scores: Tensor,
    points: Tensor, *rest: float,
) -> None:  # fmt: skip
    (b, n, h, w), (height, width, x_min, y_min, cell_m, rows, cols) = scores.shape, rest[9:]
    depths, matrices = depths.unflatten(0, (b, n)).unflatten(3, (h, w)), matrices.unflatten(0, (b, n))
    chosen = ((h * height, w * width), _grid(rows, cols, x_min, y_min, cell_m), None)
    wanted = score_and_lift_pixels_reference(keypoints, depths, centres, matrices, valid > 0, *chosen)
    for out, own in zip((scores, points), wanted, strict=True):
        out.copy_(own)


@_of_kernel
def _take_cells(
    features: Tensor, indices: Tensor, rows: Tensor, means: Tensor, valid: Tensor, out: Tensor, *rest: float
) -> None:
    x_min, y_min, cell_m = rest[6:]
    wanted = gather_cells_reference(features, indices, rows, _grid(2, 2, x_min, y_min, cell_m))
    for made, own in zip((means, valid, out), wanted, strict=True):
        made.copy_(own)


@_of_kernel
def _window(
    means: Tensor, scales: Tensor, directions: Tensor, exact: Tensor, corners: Tensor, bases: Tensor, counts: Tensor,
    num: int, *rest: float,
) -> None:  # fmt: skip
    grid = _grid(*rest[:5])
    centres, reach, table = gaussian_windows(means, scales, directions, grid, rest[5])
    low, high = window_corners(centres, reach, grid)
    sizes = (high - low + 1).clamp(min=0)
    corners.copy_(torch.cat([low, sizes[:, :1]], 1))
    bases.copy_(table[:, :4])
    counts.copy_(sizes.prod(1))


@_of_kernel
def _pair(
    corners: Tensor, bases: Tensor, ends: Tensor, scales: Tensor, directions: Tensor, batch: Tensor, owners: Tensor,
    keys: Tensor, q: Tensor, delta: Tensor, missing: Tensor, size: int, num: int, steps: int, rows: int, cols: int,
    num_cells: int, step: int, cell_m: float, limit: float,
) -> None:  # fmt: skip
    place = torch.arange(size)
    owner = torch.searchsorted(ends, place, right=True)
    inside, owner = owner < num, owner.clamp(max=num - 1)
    low_col, low_row, width = corners.long()[owner].unbind(1)
    own = place - F.pad(ends, (1, 0))[owner]
    row, col = low_row + own // width.clamp(min=1), low_col + own % width.clamp(min=1)
    table = torch.cat([bases, directions, scales], 1)[owner]
    distance, *offsets = cell_distances(table, row, col, _grid(rows, cols, 0.0, 0.0, cell_m))
    near = inside & (distance <= limit)
    owners.copy_(owner)
    keys.copy_(torch.where(near, (batch[owner] * rows + row) * cols + col, num_cells))
    q.copy_(torch.where(near, distance, torch.inf))
    missing.copy_(-ends[-1:])
    if delta.numel() > 0:
        delta.copy_(torch.stack(offsets))


@_of_kernel
def _arrange(
    owners: Tensor, q: Tensor, keys: Tensor, order: Tensor, ends: Tensor, gaussian: Tensor, ordered_q: Tensor,
    by_gaussian: Tensor, cell_starts: Tensor, gaussian_starts: Tensor, size: int, num_cells: int, num: int, steps: int,
) -> None:  # fmt: skip
    gaussian.copy_(owners[order])
    ordered_q.copy_(q[order])
    by_gaussian[order] = torch.arange(size, dtype=by_gaussian.dtype)
    cell_starts.copy_(torch.searchsorted(keys, torch.arange(num_cells + 2, dtype=keys.dtype).clamp(max=num_cells)))
    gaussian_starts.copy_(F.pad(ends, (1, 0)).clamp(max=size))


def _grid(rows: int, cols: int, x_min: float, y_min: float, cell_m: float) -> BEVGrid:
    centre = (x_min + 0.5 * cols * cell_m, y_min + 0.5 * rows * cell_m)
    return BEVGrid(cells=(rows, cols), cell_m=cell_m, centre_m=centre, z_range_m=(0.0, 1.0))


@_of_kernel
def _gather_product(
    rows: Tensor, weight: Tensor, bias: Tensor, residual: Tensor, out: Tensor, order: Tensor, table: Tensor,
    relu: bool, reverse: bool, *sizes: int,
) -> None:  # fmt: skip
    total = torch.zeros(out.shape)
    for matrix, seen in zip(weight.flip(0) if reverse else weight, table.long(), strict=True):
        hit = (seen >= 0).nonzero().squeeze(1)
        total.index_add_(0, hit, rows[seen[hit]].float() @ matrix.float())
    for added in (bias, residual):
        if added.data_ptr() != out.data_ptr():
            total += added.float()
    out.copy_(total.relu_() if relu else total)


@_of_kernel
def _log_free(
    q: Tensor, gaussian: Tensor, logits: Tensor, starts: Tensor, out: Tensor, occupied: Tensor, num: int, step: int,
    least: float, threshold: float,
) -> None:  # fmt: skip
    own = (F.softplus(-logits)[gaussian] + 0.5 * q).clamp(min=least)
    out.copy_(_segment_sum(log1mexp(own)[:, None], starts)[:, 0])
    occupied.copy_(-torch.expm1(out) > threshold)


@_of_kernel
def _cell_features(
    q: Tensor, gaussian: Tensor, features: Tensor, starts: Tensor, rows: Tensor, out: Tensor, channels: int
) -> None:
    out.copy_(_segment_sum(torch.exp(-0.5 * q)[:, None] * features[gaussian], starts)[rows])


@_of_kernel
def _nearest_cell(
    q: Tensor, cell: Tensor, by_gaussian: Tensor, starts: Tensor, occupied: Tensor, support: Tensor, logits: Tensor,
    peak: Tensor, contribution: Tensor, step: int,
) -> None:  # fmt: skip
    peak.fill_(-1)
    contribution.zero_()
    for gaussian, (first, last) in enumerate(zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True)):
        pairs = by_gaussian[first:last]
        pairs = pairs[occupied[cell[pairs].long()] > 0]
        if len(pairs):
            least = q[pairs].min()
            peak[gaussian] = support[cell[pairs[q[pairs] == least]].long().min()]
            contribution[gaussian] = logits[gaussian].sigmoid() * torch.exp(-0.5 * least)


def _segment_sum(values: Tensor, starts: Tensor) -> Tensor:
    if len(values) == 0:
        return values.new_zeros(len(starts) - 1, values.shape[1])
    picks = torch.arange(len(values))
    return F.embedding_bag(picks, values, starts.long(), mode="sum", include_last_offset=True)
