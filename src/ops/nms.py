"""IoU of rotated boxes and non-maximum suppression: rotated, circle and max-pool (method 7)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from src.geometry.constants import on_device
from src.geometry.tensor_transforms import rotate_back
from src.ops.fixed_shapes import fixed_shapes
from src.ops.kernel_maps import submanifold_map
from src.ops.sites import Sites

# Pairs of boxes intersected at a time: bounds the memory where many boxes pile up, and stays in the cache.
PAIR_CHUNK = 8192


@torch.no_grad()
def conflicting_pairs(
    boxes: Tensor,  # [n, 5] (x, y, length, width, yaw), block after block, best first within each
    counts: list[int],  # boxes of each block
    radii_m: list[float | None],  # of each block: the distance of a conflict; None: by overlap
    iou_threshold: float,
) -> tuple[Tensor, Tensor]:  # [pairs] int64 better row, ascending within its block, and [pairs] int64 worse row
    """Conflicting pairs within each block: too near each other, or an IoU above the threshold.

    Synchronises with a GPU three times, however many blocks there are. Computed in float64.
    """
    boxes = boxes.detach().double()
    by_distance, by_overlap, start = [], [], 0
    for count, radius in zip(counts, radii_m, strict=True):
        if count > 1 and radius is not None:
            by_distance.append((start, count, radius**2))
        elif count > 1:
            by_overlap.append((start, count, None))
        start += count
    near, meeting = (_near_pairs(boxes, blocks) for blocks in (by_distance, by_overlap))
    overlapping = (pair_iou(boxes, boxes, *meeting) > iou_threshold).nonzero().squeeze(1)
    better, worse = (torch.cat([first, second[overlapping]]) for first, second in zip(near, meeting, strict=True))
    return better, worse


Block = tuple[int, int, float | None]
"""First row, number of rows, and the squared radius in m^2 or None for circumscribed circles that meet."""


def _near_pairs(
    boxes: Tensor,  # [n, 5] float64
    blocks: list[Block],  # all with a radius or all without
) -> tuple[Tensor, Tensor]:  # [pairs] int64 better row, [pairs] int64 worse row
    """Pairs of rows of one block that are near each other."""
    at_once = _blocks_at_once(len(blocks), boxes.device)
    table = torch.cat([boxes[:, :2], 0.5 * boxes[:, 2:4].norm(dim=1, keepdim=True)], dim=1)
    better = worse = torch.zeros(0, dtype=torch.int64, device=boxes.device)
    for first in range(0, len(blocks), at_once):
        starts, sizes, squares = zip(*blocks[first : first + at_once], strict=True)
        starts, sizes = on_device((starts, sizes), torch.int64, boxes.device)
        place = torch.arange(max(size for _, size, _ in blocks[first : first + at_once]), device=boxes.device)
        present = place < sizes[:, None]
        x, y, half = F.embedding(torch.where(present, starts[:, None] + place, 0), table).unbind(2)  # [S, K] each
        squared = (x[:, :, None] - x[:, None]).square() + (y[:, :, None] - y[:, None]).square()
        if squares[0] is None:
            reach = (half[:, :, None] + half[:, None]).square()
        else:
            reach = on_device(squares, boxes.dtype, boxes.device)[:, None, None]
        near = (squared <= reach) & present[:, :, None] & present[:, None]
        block, row, column = near.triu(1).nonzero(as_tuple=True)
        better = torch.cat([better, starts[block] + row])
        worse = torch.cat([worse, starts[block] + column])
    return better, worse


def _blocks_at_once(count: int, device: torch.device) -> int:
    """Blocks are padded to the largest: wasted work on a CPU, cheaper than one synchronisation per block on a GPU."""
    return 1 if device.type == "cpu" else max(count, 1)


def greedy_survivors(
    better: list[int],  # [pairs], ascending among the rows that conflict with one another
    worse: list[int],  # [pairs], each above its partner
    num: int,
) -> list[int]:
    """Rows that survive when every kept row removes the later ones it is in conflict with."""
    dropped = [False] * num
    # In the order of `better`, so that a row's own fate is settled before it removes others.
    for first, second in zip(better, worse, strict=True):
        if not dropped[first]:
            dropped[second] = True
    return [row for row, gone in enumerate(dropped) if not gone]


def maxpool_peaks(
    scores: Tensor,  # [M, c]
    sites: Sites,  # M sites in 2D
) -> Tensor:  # [M, c] bool
    """Max-pool NMS: where a score is the maximum of its 3x3 neighbourhood among the sites, channel by channel."""
    if len(scores) != len(sites):
        raise ValueError(f"{len(scores)} rows of scores on {len(sites)} sites: expected one row a site")
    if len(sites) == 0:
        return torch.zeros_like(scores, dtype=torch.bool)
    maps = submanifold_map(sites, 3)
    if fixed_shapes() is not None:
        table = maps.table.t()  # [M, 9]
        padded = F.pad(scores, (0, 0, 1, 0), value=-torch.inf)  # -1 takes the row before them
        return scores == F.embedding_bag(table + 1, padded, mode="max")
    order, starts = maps.by_output
    picks = maps.inputs.index_select(0, order)
    scores = scores.detach()
    return scores == F.embedding_bag(picks, scores, starts[:-1], mode="max")


def pair_iou(
    a: Tensor,  # [n, 5] float64
    b: Tensor,  # [m, 5] float64
    i: Tensor,  # [pairs] int64, row of a
    j: Tensor,  # [pairs] int64, row of b
) -> Tensor:  # [pairs]
    """Intersection over union of pairs of rotated rectangles (x, y, length, width, yaw): metres, radians."""
    iou = a.new_zeros(len(i))
    for start in range(0, len(i), PAIR_CHUNK):
        span = slice(start, start + PAIR_CHUNK)
        first, second = a.index_select(0, i[span]), b.index_select(0, j[span])
        shared = _intersection(first, second)
        whole = first[:, 2] * first[:, 3] + second[:, 2] * second[:, 3] - shared
        iou[span] = torch.where(whole > 0, shared / torch.where(whole > 0, whole, 1.0), 0.0)
    return iou


def _intersection(
    a: Tensor,  # [pairs, 5] float64
    b: Tensor,  # [pairs, 5] float64
) -> Tensor:  # [pairs]
    """Area of the intersection of each pair of rectangles.

    In the frame of b the area is the integral over |x| <= l_b / 2 of the part of a between y = -w_b / 2 and w_b / 2.
    Along the boundary of a this is minus the sum over its edges of the integral of y clamped to that band, a continuous
    formula: shared edges, equal boxes and nearly parallel sides need no special case.
    """
    cosine, sine = b[:, 4].cos(), b[:, 4].sin()
    centre = torch.stack(rotate_back(cosine, sine, *(a[:, :2] - b[:, :2]).unbind(1)), 1)
    turn = a[:, 4] - b[:, 4]
    along = torch.stack([turn.cos(), turn.sin()], 1) * 0.5 * a[:, 2:3]
    across = torch.stack([-turn.sin(), turn.cos()], 1) * 0.5 * a[:, 3:4]
    corners = centre[:, None] + torch.stack([along + across, across - along, -along - across, along - across], 1)
    half_x, half_y = 0.5 * b[:, 2:3], 0.5 * b[:, 3:4]  # [pairs, 1]
    start, end = corners, corners.roll(-1, 1)  # [pairs, 4, 2], counter-clockwise
    x0, x1 = start[..., 0], end[..., 0]
    y0, rise = start[..., 1], end[..., 1] - start[..., 1]
    left, right = x0.clamp(-half_x, half_x), x1.clamp(-half_x, half_x)
    # The stretch of the edge above |x| <= half_x, as fractions of the edge, and its heights.
    run = torch.where(x1 == x0, 1.0, x1 - x0)
    low, high = y0 + rise * ((left - x0) / run).clamp(0, 1), y0 + rise * ((right - x0) / run).clamp(0, 1)
    return -((right - left) * _mean_clamped(low, high, half_y)).sum(1).clamp(max=0)


def _mean_clamped(
    first: Tensor,  # [pairs, 4]
    last: Tensor,  # [pairs, 4]
    bound: Tensor,  # [pairs, 1]
) -> Tensor:  # [pairs, 4]
    """Mean of clamp(y, -bound, bound) for y running linearly from first to last."""
    rise = last - first
    safe = torch.where(rise == 0, 1.0, rise)
    cuts = torch.stack([(-bound - first) / safe, (bound - first) / safe]).clamp(0, 1)
    enter, leave = cuts.amin(0), cuts.amax(0)
    flat = rise == 0
    enter, leave = torch.where(flat, 0.0, enter), torch.where(flat, 1.0, leave)
    at_first, at_last = first.clamp(-bound, bound), last.clamp(-bound, bound)
    at_enter, at_leave = (first + rise * enter).clamp(-bound, bound), (first + rise * leave).clamp(-bound, bound)
    return enter * at_first + (leave - enter) * 0.5 * (at_enter + at_leave) + (1 - leave) * at_last
