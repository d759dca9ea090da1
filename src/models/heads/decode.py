"""From head predictions to boxes: candidates, box codes, suppression, attributes, limits (method 7)."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from enum import Enum

import torch
from torch import Tensor

from src.errors import ConfigError
from src.geometry.constants import constant, on_device
from src.ops.box_codes import WIDTHS
from src.ops.nms import conflicting_pairs, greedy_survivors
from src.structures.boxes import Boxes3D
from src.structures.taxonomy import ATTRIBUTES, CLASS_ATTRIBUTE_PREFIX, CLASS_RANGE_M, CLASSES, MAX_BOXES_PER_SAMPLE
from src.targets.heatmap import GROUP_OF_CLASS, HEAD_GROUPS

MAX_CANDIDATES_PER_GROUP = 500
"""Best (cell, class) scores of a group; the public limit of 1000 before NMS lies above it and never binds."""
MAX_BOXES_PER_GROUP = 83
ROTATED_IOU = 0.2

GROUP_COLUMNS = tuple(CLASSES.index(name) for group in HEAD_GROUPS for name in group)
"""Classes in the order of the groups."""
COLUMN_GROUPS = tuple(GROUP_OF_CLASS[label] for label in GROUP_COLUMNS)
RANGES_M = tuple(CLASS_RANGE_M[name] for name in CLASSES)

CIRCLE_GROUPS = tuple(
    number for number, group in enumerate(HEAD_GROUPS) if {"barrier", "pedestrian", "traffic_sign"} & set(group)
)
"""Groups of small or static objects, suppressed by centre distance in the per-group table."""
CIRCLE_RADII_M = (2.0, 3.46, 3.16, 1.0, 0.92, 0.4, 1.0)
"""Distances of circle NMS per group; the vehicles' are the roots of CenterPoint's squared ones."""


def _attribute_of_classes(pedestrian: str, cycle: str, **vehicles: str) -> tuple[int, ...]:
    """Attribute of every class, `vehicle` being that of all vehicles without their own; -1 for classes without."""
    chosen = {"pedestrian.": pedestrian, "cycle.": cycle, "traffic_sign.": "pole_mounted"}
    table = []
    for name in CLASSES:
        prefix = CLASS_ATTRIBUTE_PREFIX[name]
        if prefix is None:
            table.append(-1)
        else:
            word = vehicles.get(name, vehicles["vehicle"]) if prefix == "vehicle." else chosen[prefix]
            table.append(ATTRIBUTES.index(prefix + word))
    return tuple(table)


STILL_ATTRIBUTES = _attribute_of_classes("standing", "without_rider", vehicle="parked", bus="stopped")
MOVING_ATTRIBUTES = _attribute_of_classes("moving", "with_rider", vehicle="moving")
OVERHANGING = tuple(
    ATTRIBUTES.index("traffic_sign.overhanging") if name == "traffic_sign" else None for name in CLASSES
)
ATTRIBUTE_RULES = (
    STILL_ATTRIBUTES,
    MOVING_ATTRIBUTES,
    *(
        tuple(own if high is None else high for own, high in zip(low, OVERHANGING, strict=True))
        for low in (STILL_ATTRIBUTES, MOVING_ATTRIBUTES)
    ),
)
"""Rules of `attributes_by_rule`: signs are overhanging where their lower edge is above 3.5 m."""


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


@dataclass(kw_only=True)
class DecodeConfig:
    """Which boxes every head gives (`model.head`). Raises ConfigError for impossible values."""

    score_threshold: float  # boxes at or below are dropped
    max_boxes: int  # per sample, best scores

    def __post_init__(self) -> None:
        if not 0 <= self.score_threshold < 1:
            raise ConfigError(f"model.head.score_threshold={self.score_threshold}: must be in 0..1, 1 excluded")
        if not 1 <= self.max_boxes <= MAX_BOXES_PER_SAMPLE:
            raise ConfigError(
                f"model.head.max_boxes={self.max_boxes}: must be in 1..{MAX_BOXES_PER_SAMPLE}; evaluators refuse more"
            )


@dataclass
class Candidates:
    """The best (cell, class) pairs, group after group and sample after sample, best first within each."""

    rows: Tensor  # [n] int64, row of the cell in the map
    labels: Tensor  # [n] int64, index into taxonomy.CLASSES
    scores: Tensor  # [n]
    counts: list[list[int]]  # of each group: candidates of each sample


def top_candidates(
    scores: Tensor,  # [M, 12] columns as taxonomy.CLASSES
    samples: Tensor,  # [M] int64, sample of each cell, ascending
    batch_size: int,
    threshold: float,
    limit: int = MAX_CANDIDATES_PER_GROUP,
) -> Candidates:
    """Per group and sample the `limit` best scores above the threshold, in descending order, ties by cell and class.

    Synchronises with a GPU once.
    """
    columns, groups = constant((GROUP_COLUMNS, COLUMN_GROUPS), torch.int64, scores.device)  # [12] each, by group
    passing = scores.index_select(1, columns) > threshold
    if batch_size == 1:
        by_column = passing.sum(0)[None]  # [B, 12]
    else:
        by_column = columns.new_zeros(batch_size, len(columns)).index_add(0, samples, passing.long())
    found = columns.new_zeros(len(HEAD_GROUPS), batch_size).index_add(0, groups, by_column.t()).tolist()

    hits = torch.nonzero_static(passing.flatten(), size=sum(map(sum, found))).squeeze(1)
    rows = torch.div(hits, len(columns), rounding_mode="floor")
    column = hits - rows * len(columns)
    labels = columns[column]
    best = scores[rows, labels]
    order = best.argsort(descending=True, stable=True)
    block = groups[column] * batch_size + samples[rows]
    order = order[block[order].argsort(stable=True)]
    counts = [[min(count, limit) for count in of_samples] for of_samples in found]
    if counts != found:
        starts = itertools.accumulate(itertools.chain([0], *found))
        kept = [torch.arange(first, first + count) for first, count in zip(starts, sum(counts, []), strict=False)]
        order = order[torch.cat(kept).to(order.device)]
    return Candidates(rows[order], labels[order], best[order], counts)


def boxes_of_columns(
    columns: Tensor,  # [n, sum of WIDTHS]
) -> Boxes3D:
    """Boxes from the columns that `decoded_boxes` gives."""
    centers, sizes, yaws, velocities, scores, labels, attributes, _ = columns.split(WIDTHS, dim=1)
    return Boxes3D(
        centers=centers,
        sizes=sizes,
        yaws=yaws.squeeze(1),
        velocities=velocities,
        labels=labels.squeeze(1).long(),
        attributes=attributes.squeeze(1).long(),
        scores=scores.squeeze(1),
    )


def suppress(
    boxes: Boxes3D,  # group after group and sample after sample, best first within each
    counts: list[list[int]],  # of each group: boxes of each sample
    method: Suppression,
    max_boxes: int,
    class_ranges: bool = True,
) -> list[Boxes3D]:  # one of each sample, best first
    """Thin out overlapping boxes of a group, of any class, and keep the best MAX_BOXES_PER_GROUP of them.

    Then drop those beyond their class's official evaluation range (xy distance to the ego origin), unless the model is
    scored farther away (`class_ranges`), and keep the `max_boxes` best of a sample. `maxpool` has thinned the cells
    before and only applies the limits.
    """
    blocks = sum(counts, [])
    better = worse = boxes.labels[:0]
    if method is not Suppression.maxpool:
        circle = range(len(counts)) if method is Suppression.circle else ()
        circle = CIRCLE_GROUPS if method is Suppression.per_group else circle
        radii = [CIRCLE_RADII_M[group] if group in circle else None for group in range(len(counts)) for _ in counts[0]]
        better, worse = conflicting_pairs(boxes.bev(), blocks, radii, ROTATED_IOU)
    ranges = RANGES_M if class_ranges else (math.inf,) * len(CLASSES)
    ranges = constant(ranges, boxes.centers.dtype, boxes.centers.device)
    near = boxes.centers[:, :2].norm(dim=1) < ranges[boxes.labels]

    # One transfer of all that the choice depends on, since each synchronises a GPU; float64 holds every value exactly.
    parts = (better, worse, near, boxes.scores)
    values = torch.cat([part.double() for part in parts]).cpu().split([len(part) for part in parts])
    better, worse = values[0].long().tolist(), values[1].long().tolist()
    near, scores = values[2].bool().tolist(), values[3].tolist()
    survivors = iter(greedy_survivors(better, worse, len(boxes)))
    row, chosen = next(survivors, None), [[] for _ in counts[0]]
    for block, end in enumerate(itertools.accumulate(blocks)):
        kept = []
        while row is not None and row < end:
            kept.append(row)
            row = next(survivors, None)
        chosen[block % len(chosen)] += [row for row in kept[:MAX_BOXES_PER_GROUP] if near[row]]
    best = [sorted(rows, key=lambda row: -scores[row])[:max_boxes] for rows in chosen]  # stable: ties by group
    return [boxes[on_device(rows, torch.int64, boxes.labels.device)] for rows in best]


def allowed_attributes(device: torch.device) -> Tensor:  # [12, 11] bool
    """Which attributes each class can carry."""
    prefixes = [CLASS_ATTRIBUTE_PREFIX[name] for name in CLASSES]
    table = tuple(
        tuple(prefix is not None and attribute.startswith(prefix) for attribute in ATTRIBUTES) for prefix in prefixes
    )
    return constant(table, torch.bool, device)


def learned_attributes(
    logits: Tensor,  # [K, 11]
    labels: Tensor,  # [K] int64
) -> Tensor:  # [K] int64, -1 for classes without
    """The most likely attribute among those of each box's class."""
    allowed = allowed_attributes(labels.device)[labels]
    best = logits.masked_fill(~allowed, -torch.inf).argmax(dim=1)
    return torch.where(allowed.any(dim=1), best, -1)
