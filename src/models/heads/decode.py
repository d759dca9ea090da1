"""From head predictions to boxes: candidates, box codes, suppression, attributes, limits (spec section 7)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import torch
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.ops.nms import nms_circle, nms_rotated
from src.structures.boxes import Boxes3D
from src.structures.taxonomy import ATTRIBUTES, CLASS_ATTRIBUTE_PREFIX, CLASS_RANGE_M, CLASSES
from src.targets.heatmap import HEAD_GROUPS

MAX_CANDIDATES_PER_GROUP = 500
"""Best (cell, class) scores of a group; the public limit of 1000 before NMS lies above it and never binds."""
MAX_BOXES_PER_GROUP = 83
LOG_SIZE_LIMIT = 5.0
ROTATED_IOU = 0.2
MOVING_MPS = 0.2
OVERHEAD_M = 3.5

CIRCLE_GROUPS = tuple(
    number for number, group in enumerate(HEAD_GROUPS) if {"barrier", "pedestrian", "traffic_sign"} & set(group)
)
"""Groups of small or static objects, suppressed by centre distance in the per-group table."""
CIRCLE_RADII_M = (2.0, 3.46, 3.16, 1.0, 0.92, 0.4, 1.0)
"""Distances of circle NMS per group; the vehicles' are the roots of CenterPoint's squared ones."""


class Suppression(Enum):
    """How overlapping boxes of a group are thinned out."""

    per_group = "per_group"
    rotated = "rotated"
    circle = "circle"
    maxpool = "maxpool"


class AttributeSource(Enum):
    """Where predicted attributes come from: the speed, or a learned branch."""

    rule = "rule"
    learned = "learned"


@dataclass
class Candidates:
    """The best (cell, class) pairs of one group, sample after sample, best first within each."""

    rows: Tensor  # [n] int64, row of the cell in the map
    labels: Tensor  # [n] int64, index into taxonomy.CLASSES
    scores: Tensor  # [n]
    counts: list[int]  # B, candidates of each sample


def top_candidates(
    scores: Tensor,  # [M, c] of the classes of one group
    labels: Tensor,  # [c] int64, index of each column in taxonomy.CLASSES
    cell_counts: list[int],  # B, cells of each sample in the map
    threshold: float,
    limit: int = MAX_CANDIDATES_PER_GROUP,
) -> Candidates:
    """Per sample the `limit` best scores above the threshold, in descending order."""
    rows, columns, kept, counts, first = [], [], [], [], 0
    for part in scores.split(cell_counts):
        flat = part.flatten()
        passing = (flat > threshold).nonzero().squeeze(1)
        order = flat[passing].argsort(descending=True, stable=True)[:limit]
        passing = passing[order]
        rows.append(first + torch.div(passing, scores.shape[1], rounding_mode="floor"))
        columns.append(passing % scores.shape[1])
        kept.append(flat[passing])
        counts.append(len(passing))
        first += len(part)
    return Candidates(torch.cat(rows), labels[torch.cat(columns)], torch.cat(kept), counts)


def boxes_from_codes(
    cells: Tensor,  # [n, 2] int64 (row, col)
    codes: Tensor,  # [n, CODE_SIZE]
    labels: Tensor,  # [n] int64
    scores: Tensor,  # [n]
    grid: BEVGrid,
) -> Boxes3D:
    """Invert the box code: x = (col + dx) * cell + x_min, sizes = exp(clamp(., -5, 5)), yaw = atan2(sin, cos)."""
    lower = codes.new_tensor([grid.x_min_m, grid.y_min_m])
    xy = (cells.flip(1).to(codes.dtype) + codes[:, :2]) * grid.cell_m + lower
    return Boxes3D(
        centers=torch.cat([xy, codes[:, 2:3]], dim=1),
        sizes=codes[:, 3:6].clamp(-LOG_SIZE_LIMIT, LOG_SIZE_LIMIT).exp(),
        yaws=torch.atan2(codes[:, 7], codes[:, 6]),
        velocities=codes[:, 8:10],
        labels=labels,
        attributes=torch.full_like(labels, -1),
        scores=scores,
    )


def suppress(
    boxes: Boxes3D,  # one sample and group, best first
    group: int,
    method: Suppression,
) -> Boxes3D:
    """Thin out overlapping boxes, whatever their classes, and keep the best MAX_BOXES_PER_GROUP.

    `maxpool` has thinned the cells before and only applies the limit.
    """
    if method is Suppression.per_group:
        method = Suppression.circle if group in CIRCLE_GROUPS else Suppression.rotated
    if method is Suppression.rotated:
        boxes = boxes[nms_rotated(boxes.bev(), boxes.scores, ROTATED_IOU)]
    elif method is Suppression.circle:
        boxes = boxes[nms_circle(boxes.centers[:, :2], boxes.scores, CIRCLE_RADII_M[group])]
    return boxes[torch.arange(min(len(boxes), MAX_BOXES_PER_GROUP), device=boxes.labels.device)]


def within_limits(
    boxes: Boxes3D,  # one sample, ego frame
    max_boxes: int,
) -> Boxes3D:
    """Drop boxes beyond their class's evaluation range (xy distance to the ego origin); keep the best, best first."""
    ranges = boxes.centers.new_tensor([CLASS_RANGE_M[name] for name in CLASSES])
    boxes = boxes[boxes.centers[:, :2].norm(dim=1) < ranges[boxes.labels]]
    return boxes[boxes.scores.argsort(descending=True, stable=True)[:max_boxes]]


def rule_attributes(
    boxes: Boxes3D,
) -> Tensor:  # [K] int64, -1 for none
    """Attributes from the speed (table of section 7); signs are overhanging where their lower edge is above 3.5 m."""
    moving = _attribute_table("moving", "moving", "with_rider", "pole_mounted")
    still = _attribute_table("parked", "standing", "without_rider", "pole_mounted")
    still[CLASSES.index("bus")] = ATTRIBUTES.index("vehicle.stopped")
    labels = boxes.labels
    chosen = torch.where(
        boxes.velocities.norm(dim=1) > MOVING_MPS, labels.new_tensor(moving)[labels], labels.new_tensor(still)[labels]
    )
    overhead = (labels == CLASSES.index("traffic_sign")) & (boxes.centers[:, 2] - 0.5 * boxes.sizes[:, 2] > OVERHEAD_M)
    return torch.where(overhead, ATTRIBUTES.index("traffic_sign.overhanging"), chosen)


def _attribute_table(vehicle: str, pedestrian: str, cycle: str, sign: str) -> list[int]:
    """Attribute of every class, given the one of each family; -1 for classes without."""
    chosen = {"vehicle.": vehicle, "pedestrian.": pedestrian, "cycle.": cycle, "traffic_sign.": sign}
    prefixes = [CLASS_ATTRIBUTE_PREFIX[name] for name in CLASSES]
    return [-1 if prefix is None else ATTRIBUTES.index(prefix + chosen[prefix]) for prefix in prefixes]


def allowed_attributes(device: torch.device) -> Tensor:  # [12, 11] bool
    """Which attributes each class can carry."""
    prefixes = [CLASS_ATTRIBUTE_PREFIX[name] for name in CLASSES]
    table = [[prefix is not None and attribute.startswith(prefix) for attribute in ATTRIBUTES] for prefix in prefixes]
    return torch.tensor(table, device=device)


def learned_attributes(
    logits: Tensor,  # [K, 11]
    labels: Tensor,  # [K] int64
) -> Tensor:  # [K] int64, -1 for classes without
    """The most likely attribute among those of each box's class."""
    allowed = allowed_attributes(labels.device)[labels]
    best = logits.masked_fill(~allowed, -torch.inf).argmax(dim=1)
    return torch.where(allowed.any(dim=1), best, -1)
