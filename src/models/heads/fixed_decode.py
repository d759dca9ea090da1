"""Decoding in fixed shapes: the best candidates of every group as one tensor, for one copy to the host (method 7)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.geometry.constants import constant, counting, where_else
from src.models.heads.center_head import CenterHead, HeadOutput, decoded_codes
from src.models.heads.decode import (
    MAX_BOXES_PER_GROUP,
    MAX_CANDIDATES_PER_GROUP,
    Suppression,
    boxes_from_codes,
    learned_attributes,
    rule_attributes,
    suppress,
)
from src.ops.nms import maxpool_peaks
from src.structures.boxes import Boxes3D
from src.structures.taxonomy import CLASSES
from src.targets.heatmap import CODE_SIZE, HEAD_GROUPS

MOST_CLASSES = max(len(group) for group in HEAD_GROUPS)
CLASS_TABLE = tuple(
    tuple(CLASSES.index(name) for name in group) + (len(CLASSES),) * (MOST_CLASSES - len(group))
    for group in HEAD_GROUPS
)
"""Classes of every group; where there is none, a column behind the last."""
RANK_BITS = 31
WIDTHS = (3, 3, 1, 2, 1, 1, 1, 1)
"""Centre, size, yaw, velocity, score, label, attribute, and whether there is such a box."""


class FixedDecode(nn.Module):
    """Boxes of one frame from the output of a head that is prepared for inference."""

    def __init__(self, head: CenterHead) -> None:
        super().__init__()
        self.head, self.peaks = head, head.config.nms is Suppression.maxpool
        # Of max-pool NMS no more can stay of a group; the other methods choose among all candidates.
        self.count = MAX_BOXES_PER_GROUP if self.peaks else MAX_CANDIDATES_PER_GROUP
        first = [part.hidden for part in head.regressions]
        second = [part.outputs for part in head.regressions]
        for name, layers in (("first", first), ("second", second)):
            weight, bias = (torch.stack([getattr(layer, key) for layer in layers]) for key in ("weight", "bias"))
            self.register_buffer(f"{name}_weight", weight.transpose(1, 2).contiguous(), persistent=False)
            self.register_buffer(f"{name}_bias", bias[:, None], persistent=False)

    @torch.no_grad()
    def forward(self, output: HeadOutput) -> Tensor:  # [groups, n, sum of WIDTHS] float32
        """Candidates of every group, best first; those with score 0 at the end are none."""
        sites, scores = output.bev.sites, output.logits.sigmoid()
        if self.peaks:
            scores = scores * maxpool_peaks(scores, sites)
        scores = where_else((sites.keys < sites.end)[:, None], scores, 0.0)  # padding may hold what is not finite
        best, rows, labels = best_candidates(scores, min(self.count, MOST_CLASSES * len(scores)))  # [groups, n] each
        codes = self._regress(output.bev.features.index_select(0, rows.flatten()).unflatten(0, rows.shape))
        rows, labels, best = rows.flatten(), labels.flatten(), best.flatten()
        codes = decoded_codes(output, codes.flatten(0, 1), rows)
        cells = output.bev.indices.index_select(0, rows)[:, 1:]
        boxes = boxes_from_codes(cells, codes[:, :CODE_SIZE], labels, best, self.head.grid)
        if self.head.learned:
            attributes = learned_attributes(codes[:, CODE_SIZE:], labels)
        else:
            attributes = rule_attributes(boxes)
        single = (boxes.scores, labels, attributes, boxes.scores > self.head.config.score_threshold)
        columns = (boxes.centers, boxes.sizes, boxes.yaws[:, None], boxes.velocities, *(x[:, None] for x in single))
        return torch.cat([column.float() for column in columns], dim=1).unflatten(0, (len(HEAD_GROUPS), -1))

    def _regress(
        self,
        features: Tensor,  # [groups, n, C]
    ) -> Tensor:  # [groups, n, CODE_SIZE (+ 11)]
        """As `CenterHead.regress`, all groups in two products."""
        hidden = torch.baddbmm(self.first_bias, features.to(self.first_weight.dtype), self.first_weight).relu()
        with torch.autocast(features.device.type, enabled=False):
            return torch.baddbmm(self.second_bias, hidden.float(), self.second_weight)

    def boxes(
        self,
        candidates: Tensor,  # [groups, n, sum of WIDTHS] of `forward`, on the CPU
    ) -> Boxes3D:
        """What is left of them, best first."""
        counts = [[count] for count in (candidates[..., -1] > 0).sum(1).tolist()]
        found = candidates[candidates[..., -1] > 0]
        centers, sizes, yaws, velocities, scores, labels, attributes, _ = found.split(WIDTHS, dim=1)
        boxes = Boxes3D(
            centers=centers,
            sizes=sizes,
            yaws=yaws.squeeze(1),
            velocities=velocities,
            labels=labels.squeeze(1).long(),
            attributes=attributes.squeeze(1).long(),
            scores=scores.squeeze(1),
        )
        (kept,) = suppress(boxes, counts, self.head.config.nms, self.head.config.max_boxes)
        return kept


def best_candidates(
    scores: Tensor,  # [M, classes]
    count: int,
) -> Sequence[Tensor]:  # [groups, count] each: float32; int64, row; int64, index into CLASSES
    """The best (cell, class) pairs of every group in descending order, ties by cell and class."""
    table = constant(CLASS_TABLE, torch.int64, scores.device)
    by_group = F.pad(scores.float(), (0, 1)).index_select(1, table.flatten())  # [M, groups * MOST_CLASSES]
    by_group = by_group.unflatten(1, table.shape).transpose(0, 1).flatten(1)  # [groups, M * MOST_CLASSES]
    # Scores are not negative, so their bits are in their order; less the place, so that the first comes first.
    place = counting(by_group.shape[1], torch.int64, scores.device)
    ranks = (by_group.contiguous().view(torch.int32).long() << RANK_BITS) - place
    places = -ranks.topk(count, dim=1).values & (2**RANK_BITS - 1)
    rows = torch.div(places, MOST_CLASSES, rounding_mode="floor")
    labels = table.gather(1, places - rows * MOST_CLASSES).clamp(max=scores.shape[1] - 1)
    return by_group.gather(1, places), rows, labels
