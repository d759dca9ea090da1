"""Decoding in fixed shapes: the best candidates of every group as one tensor, for one copy to the host (method 7)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from src.models.heads.center_head import CenterHead, HeadOutput
from src.models.heads.decode import (
    MAX_BOXES_PER_GROUP,
    MAX_CANDIDATES_PER_GROUP,
    Suppression,
    boxes_of_columns,
    suppress,
)
from src.ops.candidate_sort_keys import candidate_sort_keys, unpack_candidates
from src.ops.sites import Sites
from src.structures.boxes import Boxes3D
from src.structures.taxonomy import CLASSES
from src.targets.heatmap import HEAD_GROUPS

MOST_CLASSES = max(len(group) for group in HEAD_GROUPS)
CLASS_TABLE = tuple(
    tuple(CLASSES.index(name) for name in group) + (len(CLASSES),) * (MOST_CLASSES - len(group))
    for group in HEAD_GROUPS
)
"""Classes of every group; where there is none, a column behind the last."""


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
        count = min(self.count, MOST_CLASSES * len(output.logits))
        best, rows, labels = best_candidates(output.logits, output.bev.sites, count, self.peaks)  # [groups, n] each
        codes = self._regress(output.bev.features.index_select(0, rows.flatten()).unflatten(0, rows.shape))
        rows, labels, best = rows.flatten(), labels.flatten(), best.flatten()
        found = self.head.columns(output, codes.flatten(0, 1), rows, labels, best)
        return found.float().unflatten(0, (len(HEAD_GROUPS), -1))

    def _regress(
        self,
        features: Tensor,  # [groups, n, C]
    ) -> Tensor:  # [groups, n, CODE_SIZE (+ 11)]
        """Box codes as `CenterHead.regress` gives them, of all groups in two products."""
        hidden = torch.baddbmm(self.first_bias, features.to(self.first_weight.dtype), self.first_weight).relu()
        with torch.autocast(features.device.type, enabled=False):
            return torch.baddbmm(self.second_bias, hidden.float(), self.second_weight)

    def boxes(
        self,
        candidates: Tensor,  # [groups, n, sum of WIDTHS] of `forward`, on the CPU
    ) -> Boxes3D:
        """Boxes that suppression leaves of the candidates, best first."""
        counts = [[count] for count in (candidates[..., -1] > 0).sum(1).tolist()]
        found = candidates[candidates[..., -1] > 0]
        head, boxes = self.head, boxes_of_columns(found)
        (kept,) = suppress(boxes, counts, head.config.nms, head.config.max_boxes, head.class_ranges)
        return kept


def best_candidates(
    logits: Tensor,  # [M, classes]
    sites: Sites,
    count: int,
    peaks: bool,  # of local maxima alone
) -> Sequence[Tensor]:  # [groups, count] each: float32; int64, row; int64, index into CLASSES
    """The best (cell, class) pairs of every group in descending order, ties by cell and class."""
    ranks = candidate_sort_keys(logits, sites, CLASS_TABLE, peaks).topk(count, dim=1).values
    return unpack_candidates(ranks, CLASS_TABLE, logits.shape[1])
