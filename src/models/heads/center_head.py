"""The sparse CenterPoint head: heat maps and box codes on active cells, its loss and its decoding (method 7)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.errors import require_least
from src.geometry.bev_grid import BEVGrid
from src.geometry.constants import constant
from src.losses.classification import penalty_reduced_focal
from src.losses.normalizers import full_precision, mean_over_ranks
from src.losses.regression import masked_l1
from src.models.detector import Objective
from src.models.heads.branches import Branches, MergedBranches, checkpointed_branches
from src.models.heads.decode import (
    ATTRIBUTE_RULES,
    GROUP_COLUMNS,
    AttributeSource,
    DecodeConfig,
    Suppression,
    allowed_attributes,
    boxes_of_columns,
    learned_attributes,
    suppress,
    top_candidates,
)
from src.models.layers.dense import DenseConvNormReLU, DenseToSparse, rows_of_map
from src.models.layers.doppler import Doppler
from src.models.layers.sparse import ConvNormReLU, SubmanifoldConv
from src.ops.box_codes import ATTRIBUTE, decoded_boxes
from src.ops.nms import maxpool_peaks
from src.ops.segment_reduce import segment_count
from src.structures.boxes import Boxes3D
from src.structures.sparse_bev import SparseBEV
from src.structures.taxonomy import ATTRIBUTES, CLASSES
from src.targets.heatmap import CODE_SIZE, GROUP_OF_CLASS, HEAD_GROUPS, HeadTargets, head_targets

# Probability 0.1 for every cell at the start, so that the focal loss is not drowned by background.
HEATMAP_BIAS = -2.19
DENSE_HEATMAP_BIAS = -4.6
"""Probability 0.01 on whole maps, where an object has some ten times as many cells without one beside it (measured: a
quarter of the heat map loss after 30 steps at the mini scale)."""
CODE_WIDTHS = (2, 1, 3, 2, 2)
"""Branches of the box code: centre, height, log sizes, (cos, sin), velocity."""
ATTRIBUTE_WEIGHT = 0.2
SAMPLED_CELLS = 1024


class TrainRegression(Enum):
    """Where the regression branches are evaluated in training.

    `all`: every cell, as specified. `sampled`: the objects' cells and about 1024 cells spread evenly over the batch,
    which keep the batch statistics those of the map; objects alone would leave rare groups with two or three rows.
    """

    all = "all"
    sampled = "sampled"


@dataclass(kw_only=True)
class HeadConfig(DecodeConfig):
    """Settings of the head (`model.head`). Raises ConfigError for impossible values."""

    nms: Suppression  # method 7
    attributes: AttributeSource
    train_regression: TrainRegression


@dataclass(kw_only=True)
class BoxOptions:
    """What a phase says to a model with this head (`phase.options`). Raises ConfigError for a negative weight."""

    velocity_code_weight: float  # weight of velocity in the box loss

    def __post_init__(self) -> None:
        require_least(self, "phase.options", {"velocity_code_weight": 0})


def code_weights(velocity_code_weight: float) -> tuple[float, ...]:  # CODE_SIZE
    """Weight of each number of a box code in the box loss."""
    return (1.0,) * (CODE_SIZE - 2) + (velocity_code_weight,) * 2


@dataclass
class HeadOutput:
    """Predictions on the M active cells of B samples."""

    bev: SparseBEV  # cells with the shared features that the regression branches read
    logits: Tensor  # [M, 12] float32, columns as taxonomy.CLASSES
    codes: Tensor | None  # [M, 7, CODE_SIZE (+ 11 attributes)] in training with `all`, else evaluated where needed
    doppler: Doppler | None = None  # velocities take their radial part from it
    base_velocities: Tensor | None = (
        None  # [M, 2] m/s over ground, augmented axes: what the velocities of codes are added to
    )


class CenterHead(nn.Module):
    """CenterPoint head on sparse cells (VoxelNeXt's nuScenes head, seven groups); 0.86 M parameters at C = 128.

    With `dense` it reads a whole map [B, C, rows, cols] and every cell is a site; the rest is the same.
    """

    def __init__(
        self,
        config: HeadConfig,
        channels: int,
        grid: BEVGrid,
        velocity_code_weight: float,
        dense: bool = False,
        in_channels: int | None = None,  # of a dense map that is wider than the head; None: C
        class_ranges: bool = True,  # boxes beyond the official range of their class go
    ) -> None:
        super().__init__()
        self.config, self.grid, self.dense, self.class_ranges = config, grid, dense, class_ranges
        self.learned = config.attributes is AttributeSource.learned
        self.code_weights = code_weights(velocity_code_weight)
        if dense:
            self.shared = nn.Sequential(
                DenseConvNormReLU(in_channels or channels, channels, 3, bias=True), DenseToSparse()
            )
        else:
            self.shared = ConvNormReLU(SubmanifoldConv(channels, channels, 3, 2, bias=True), eps=1e-5, momentum=0.1)
        self.heatmaps = nn.ModuleList(Branches(channels, (len(group),)) for group in HEAD_GROUPS)
        for branches in self.heatmaps:
            nn.init.constant_(branches.outputs[0].bias, DENSE_HEATMAP_BIAS if dense else HEATMAP_BIAS)
        widths = (*CODE_WIDTHS, len(ATTRIBUTES)) if self.learned else CODE_WIDTHS
        self.regressions = nn.ModuleList(Branches(channels, widths) for _ in HEAD_GROUPS)
        self.merged = False  # for inference
        self.class_columns = tuple(GROUP_COLUMNS.index(label) for label in range(len(CLASSES)))

    def merge_for_inference(self) -> None:
        """Heat maps of all groups are asked for in every cell, codes of one group where it has candidates."""
        self.heatmaps = nn.ModuleList([MergedBranches(list(self.heatmaps))])
        self.regressions = nn.ModuleList(MergedBranches([part]) for part in self.regressions)
        self.merged = True

    def forward(
        self,
        bev: SparseBEV | Tensor,  # a tensor [B, C, rows, cols] where the head is dense
        doppler: Doppler | None = None,
        base_velocities: Tensor | None = None,  # [B, 2, rows, cols] of a dense head, as `HeadOutput.base_velocities`
    ) -> HeadOutput:
        """Heat maps of all cells; box codes only where training needs them everywhere."""
        bev = self.shared(bev)
        if self.merged:
            logits = self.heatmaps[0](bev.features)
        else:
            logits = checkpointed_branches(list(self.heatmaps), bev.features)
        logits = logits.index_select(1, constant(self.class_columns, torch.int64, logits.device))
        codes = None
        if self.training and self.config.train_regression is TrainRegression.all:
            # All groups at once multiply more by zeros, which on a GPU costs less than seven times the launches.
            parts = list(self.regressions)
            calls = [[part] for part in parts] if bev.features.device.type == "cpu" else [parts]
            codes = torch.cat([checkpointed_branches(call, bev.features) for call in calls], dim=1)
            codes = codes.unflatten(1, (len(parts), -1))
        return HeadOutput(
            bev, logits, codes, doppler, None if base_velocities is None else rows_of_map(base_velocities)
        )

    def regress(
        self,
        output: HeadOutput,
        rows: Tensor,  # [n] int64, cells
        groups: Tensor,  # [n] int64, index into HEAD_GROUPS
    ) -> Tensor:  # [n, CODE_SIZE (+ 11)]
        """Box codes, and attribute logits if learned, of chosen cells by the branches of the given groups.

        With running statistics this equals evaluating every cell and picking; in training with `sampled` the batch
        statistics come from the chosen cells and an even sample of the others.
        """
        if output.codes is not None:
            return output.codes[rows, groups]
        order = groups.argsort(stable=True)
        counts = segment_count(groups, len(HEAD_GROUPS)).tolist()
        return self._regress_by_group(output, rows[order], counts)[order.argsort()]

    def _regress_by_group(
        self,
        output: HeadOutput,
        rows: Tensor,  # [n] int64, cells, group after group
        counts: list[int],  # of each group
    ) -> Tensor:  # [n, CODE_SIZE (+ 11)]
        features = output.bev.features
        step = max(1, len(features) // SAMPLED_CELLS)
        if self.dense:  # one gradient of a whole map instead of one for each group
            every = torch.arange(0, len(features) if self.training else 0, step, device=rows.device)
            *chosen_by_group, sampled = features.index_select(0, torch.cat([rows, every])).split([*counts, len(every)])
        else:
            chosen_by_group = [features[own] for own in rows.split(counts)]
            sampled = features[::step] if self.training else features[:0]
        codes = []
        for branches, own in zip(self.regressions, chosen_by_group, strict=True):
            chosen = torch.cat([own, sampled])
            if not torch.is_autocast_enabled(chosen.device.type):
                chosen = chosen.to(branches.hidden.weight.dtype)
            if len(chosen) or self.training or len(rows) == 0:  # otherwise a group without cells costs nothing
                codes.append(branches(chosen)[: len(own)])
        return torch.cat(codes)

    def targets(self, output: HeadOutput, boxes: list[Boxes3D]) -> HeadTargets:
        """What the head should predict on its cells, with the counts of objects that it cannot represent."""
        return head_targets(boxes, output.bev.sites, self.grid)

    def loss(
        self,
        output: HeadOutput,
        boxes: list[Boxes3D] | None,  # B, augmented ego frame
        heatmap_weight: float | None,
        box_weight: float | None,
    ) -> Objective:
        """Weighted terms `heatmap`, `box` and, if learned, `attribute`; a weight of None leaves its term out.

        Diagnostics are the objects per frame: those the head learns, those without a cell near enough, and those that
        share their cell with another of their group, so that the head cannot meet both.

        Focal loss per group over its positive cells, L1 per group over its objects (method 8.1). Without objects the
        box term is 0 with zero gradients. Raises ValueError for a batch without annotations.
        """
        targets = self.targets(output, boxes)
        counts = {
            "objects": len(targets.rows),
            "distant_objects": targets.num_distant,
            "shared_objects": targets.num_shared,
        }
        diagnostics = {name: count / len(boxes) for name, count in counts.items()}
        group_of_class = constant(GROUP_OF_CLASS, torch.int64, targets.labels.device)
        zeros = output.logits.new_zeros(len(HEAD_GROUPS))
        terms: dict[str, Tensor] = {}
        if heatmap_weight is not None:
            focal = penalty_reduced_focal(output.logits, targets.heatmap).sum(0)  # [12]
            positives = (targets.heatmap == 1).sum(0).to(zeros.dtype)
            normalizer = mean_over_ranks(zeros.index_add(0, group_of_class, positives))
            terms["heatmap"] = heatmap_weight * (zeros.index_add(0, group_of_class, focal) / normalizer).sum()
        if box_weight is None and not self.learned:
            return Objective(terms, diagnostics)
        predicted = _on_base(output, self.regress(output, targets.rows, targets.groups), targets.rows)
        if output.doppler is not None and output.doppler.config.in_losses:
            predicted = measured_codes(output, predicted, targets.rows)
        if box_weight is not None:
            code_weights = constant(self.code_weights, zeros.dtype, zeros.device)
            errors = masked_l1(predicted[:, :CODE_SIZE], targets.codes) * code_weights
            objects = segment_count(targets.groups, len(HEAD_GROUPS))
            sums = zeros.index_add(0, targets.groups, errors.sum(1))
            terms["box"] = box_weight * (sums / mean_over_ranks(objects)).sum()
        if self.learned:
            terms["attribute"] = ATTRIBUTE_WEIGHT * _attribute_loss(predicted[:, CODE_SIZE:], targets)
        return Objective(terms, diagnostics)

    @torch.no_grad()
    def decode(self, output: HeadOutput) -> list[Boxes3D]:
        """Boxes of each sample, best first, at most `max_boxes`; attributes set, frame as the input's."""
        scores = output.logits.sigmoid()
        if self.config.nms is Suppression.maxpool:
            scores = scores * maxpool_peaks(scores, output.bev.sites)
        cells = output.bev.indices
        best = top_candidates(scores, cells[:, 0], output.bev.batch_size, self.config.score_threshold)
        counts = [sum(of_samples) for of_samples in best.counts]
        if output.codes is None:
            codes = self._regress_by_group(output, best.rows, counts)
        else:
            groups = torch.arange(len(counts)).repeat_interleave(torch.tensor(counts)).to(best.rows.device)
            codes = output.codes[best.rows, groups]
        boxes = boxes_of_columns(self.columns(output, codes, best.rows, best.labels, best.scores))
        return suppress(boxes, best.counts, self.config.nms, self.config.max_boxes, self.class_ranges)

    def columns(
        self,
        output: HeadOutput,
        codes: Tensor,  # [n, CODE_SIZE (+ 11)]
        rows: Tensor,  # [n] int64, cells
        labels: Tensor,  # [n] int64
        scores: Tensor,  # [n]
    ) -> Tensor:  # [n, sum of WIDTHS]
        """Boxes as `decoded_boxes`, of learned attributes where the head has them.

        With measured velocities, along the heading if the radar's reader wants it.
        """
        doppler, threshold = output.doppler, self.config.score_threshold
        radar = None if doppler is None else (doppler.keys, doppler.velocities)
        turned = doppler is not None and doppler.config.along_heading
        cells = (rows, output.bev.indices, labels, scores)
        moving = _on_base(output, codes, rows)
        found = decoded_boxes(moving, *cells, threshold, self.grid, ATTRIBUTE_RULES, radar, turned)
        if self.learned:
            found[:, ATTRIBUTE] = learned_attributes(codes[:, CODE_SIZE:], labels).to(found.dtype)
        return found


def measured_codes(
    output: HeadOutput,
    codes: Tensor,  # [n, CODE_SIZE (+ 11)]
    rows: Tensor,  # [n] int64, cells
) -> Tensor:  # [n, CODE_SIZE (+ 11)]
    """Box codes whose velocities have the radial part that the radar measures, where it does (`Doppler.correct`)."""
    before, velocities, after = codes.split([CODE_SIZE - 2, 2, codes.shape[1] - CODE_SIZE], dim=1)
    return torch.cat([before, output.doppler.correct(velocities, output.bev.sites.linear()[rows]), after], dim=1)


def _on_base(
    output: HeadOutput,
    codes: Tensor,  # [n, CODE_SIZE (+ 11)]
    rows: Tensor,  # [n] int64, cells
) -> Tensor:  # [n, CODE_SIZE (+ 11)]
    """Box codes with `HeadOutput.base_velocities`, if there is any, added to their velocities."""
    if output.base_velocities is None:
        return codes
    return codes + F.pad(output.base_velocities[rows], (CODE_SIZE - 2, codes.shape[1] - CODE_SIZE))


def _attribute_loss(logits: Tensor, targets: HeadTargets) -> Tensor:
    """Cross-entropy over the attributes of each object's class, averaged over objects that carry one."""
    allowed = allowed_attributes(logits.device)[targets.labels]
    chosen = targets.attributes.clamp(min=0)[:, None]
    known = (targets.attributes >= 0) & allowed.gather(1, chosen).squeeze(1)
    logits = full_precision(logits)[known].masked_fill(~allowed[known], -torch.inf)
    total = F.cross_entropy(logits, targets.attributes[known], reduction="sum")
    return total / mean_over_ranks(known.sum())
