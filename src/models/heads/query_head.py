"""A head for object queries: boxes relative to their queries, the set-prediction loss, decoding without suppression."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from src.geometry.bev_grid import BEVGrid
from src.geometry.constants import constant, on_device
from src.losses.classification import sigmoid_focal
from src.losses.normalizers import mean_over_ranks
from src.losses.regression import masked_l1
from src.models.detector import Objective
from src.models.heads.center_head import code_weights
from src.models.heads.decode import ATTRIBUTE_RULES, DecodeConfig, Suppression, suppress, top_candidates
from src.models.layers.full_precision import FullPrecisionLinear
from src.ops.assignment import assign
from src.ops.box_codes import LOG_SIZE_LIMIT, attributes_by_rule
from src.structures.boxes import Boxes3D
from src.structures.queries import Queries
from src.structures.taxonomy import CLASSES, SPEED_UNIT_MPS
from src.targets.heatmap import CODE_SIZE
from src.targets.supervision import supervised_boxes, upload_boxes

INITIAL_SIZE_M = (4.5, 2.0, 1.8)
"""Length, width and height before the head has learnt any."""
CLASS_COST, BOX_COST = 2.0, 0.25
"""Weights of the assignment's costs, as in DETR3D and its successors; velocities cost nothing there."""


@dataclass
class QueryPrediction:
    """What one layer of a decoder predicts for the queries of B samples."""

    logits: Tensor  # [B, Q, 12] float32, columns as taxonomy.CLASSES
    codes: Tensor  # [B, Q, CODE_SIZE] float32: centre (m), log sizes (log m), cos, sin of the yaw, velocity (m/s)
    valid: Tensor  # [B, Q] bool

    def split(self, count: int) -> tuple[QueryPrediction, QueryPrediction]:
        """Predictions of the first `count` queries, and of the others."""
        values = (self.logits, self.codes, self.valid)
        first, others = ([value[:, part] for value in values] for part in (slice(count), slice(count, None)))
        return QueryPrediction(*first), QueryPrediction(*others)


class SetPredictionHead(nn.Module):
    """Two networks of two layers, shared by all layers of a decoder as in StreamPETR."""

    def __init__(self, config: DecodeConfig, channels: int, grid: BEVGrid, velocity_code_weight: float) -> None:
        super().__init__()
        self.config, self.grid = config, grid
        self.code_weights = code_weights(velocity_code_weight)
        self.classes, self.box = (
            nn.Sequential(
                nn.Linear(channels, channels),
                nn.LayerNorm(channels),
                nn.ReLU(),
                FullPrecisionLinear(channels, width),
            )
            for width in (len(CLASSES), CODE_SIZE)
        )
        for layer in (self.classes[-1], self.box[-1]):
            nn.init.normal_(layer.weight, std=0.01)
            nn.init.zeros_(layer.bias)
        start_codes(self.box[-1].bias)

    def forward(
        self,
        features: Tensor,  # [B, Q, C]
        queries: Queries,
    ) -> QueryPrediction:
        """Scores, centres and velocities as changes of the queries' own."""
        logits = queries.logits.float() + self.classes(features)
        centers, shape, velocities = self.box(features).split([3, CODE_SIZE - 5, 2], dim=-1)
        centers, velocities = queries.centers + centers, queries.velocities + SPEED_UNIT_MPS * velocities
        return QueryPrediction(logits, torch.cat([centers, shape, velocities], dim=-1), queries.valid)

    def of_layers(
        self,
        layers: Iterable[nn.Module],  # of a decoder: queries, embedding, remembered keys, then `sources`
        queries: Queries,
        past: Queries | None,  # further ones to look at
        embeddings: tuple[Tensor, Tensor | None],  # [B, Q, C] of the queries, [B, P, C] of the past
        *sources: Any,  # what else every layer looks at
        norm: nn.Module | None = None,  # of the features that boxes are predicted from
    ) -> tuple[list[QueryPrediction], list[Tensor]]:  # of each layer, and [B, Q, C]
        """What every layer predicts relative to the queries' own start, and the features that it predicts from."""
        own, others = embeddings
        remembered = None if past is None else (past.features + others, past.features, past.valid)
        predictions, features = [], []
        for layer in layers:
            x = layer(queries, own, remembered, *sources)
            queries = replace(queries, features=x)
            features.append(x if norm is None else norm(x))
            predictions.append(self(features[-1], queries))
        return predictions, features

    def loss(
        self,
        predictions: list[QueryPrediction],  # of each layer, of the same queries
        boxes: list[Boxes3D] | None,  # B, augmented ego frame
        class_weight: float | None,
        box_weight: float | None,
    ) -> Objective:
        """Weighted terms `class` and `box`, summed over layers, with an assignment of its own in each.

        Focal loss of every query, L1 of those that an object is assigned to; both over the objects that found one. A
        weight of None leaves its term out. Raises ValueError for a batch without annotations.
        """
        logits, codes, valid = (
            torch.stack([getattr(one, name) for one in predictions]).flatten(1, 2)
            for name in ("logits", "codes", "valid")
        )  # [L, B * Q, ...]
        objects, samples = upload_boxes(*supervised_boxes(boxes, self.grid), device=codes.device)
        wanted = box_codes(objects)
        layers, rows, own = self.match(predictions, objects.labels, wanted, samples)
        matched = mean_over_ranks(torch.tensor(len(rows) / len(predictions), device=codes.device))
        terms = {}
        if class_weight is not None:
            target = torch.zeros_like(logits, dtype=torch.bool)
            target[layers, rows, objects.labels[own]] = True
            focal = (sigmoid_focal(logits, target) * valid[..., None]).sum()
            terms["class"] = class_weight * focal / matched
        if box_weight is not None:
            terms["box"] = box_weight * self.code_errors(codes[layers, rows], wanted[own]).sum() / matched
        frames, found = len(boxes), len(rows) / len(predictions)
        return Objective(terms, {"objects": len(objects) / frames, "missed_objects": (len(objects) - found) / frames})

    def code_errors(
        self,
        codes: Tensor,  # [n, CODE_SIZE]
        wanted: Tensor,  # [n, CODE_SIZE], NaN where unknown
    ) -> Tensor:  # [n, CODE_SIZE]
        """Weighted absolute errors."""
        return masked_l1(codes, wanted) * constant(self.code_weights, torch.float32, codes.device)

    @torch.no_grad()
    def match(
        self,
        predictions: list[QueryPrediction],
        labels: Tensor,  # [K] int64, of the objects of all samples
        wanted: Tensor,  # [K, CODE_SIZE]
        samples: Tensor,  # [K] int64, ascending
    ) -> tuple[Tensor, Tensor, Tensor]:  # [n] int64 each: layer, row of B * Q, row of the objects
        """The pairs of query and object, one for one in every layer and sample, whose costs have the least sum.

        Synchronises with a GPU once.
        """
        valid, size = predictions[0].valid, predictions[0].valid.shape[1]
        costs = torch.stack([self.costs(one, labels, wanted, samples) for one in predictions])  # [L, K, Q]
        parts = [costs, valid, samples]
        flat = torch.cat([part.float().flatten() for part in parts]).cpu().split([part.numel() for part in parts])
        costs, valid, owners = (one.view(part.shape).numpy() for one, part in zip(flat, parts, strict=True))
        pairs = [np.zeros((3, 0), np.int64)]
        for sample, usable in enumerate(valid):
            queries, objects = np.flatnonzero(usable), np.flatnonzero(owners == sample)
            for layer, cost in enumerate(costs):
                own, rows = assign(cost[objects][:, queries])
                pairs.append(np.stack([np.full_like(own, layer), sample * size + queries[rows], objects[own]]))
        return on_device(np.concatenate(pairs, axis=1), torch.int64, labels.device).unbind(0)

    def costs(
        self, prediction: QueryPrediction, labels: Tensor, wanted: Tensor, samples: Tensor
    ) -> Tensor:  # [K, Q] float32
        """Cost of matching each object to each query of its sample: what focal loss and L1 would change by."""
        logits = prediction.logits.float()
        yes = torch.ones_like(logits, dtype=torch.bool)
        gain = (sigmoid_focal(logits, yes) - sigmoid_focal(logits, ~yes))[samples]  # [K, Q, 12]
        kind = gain.gather(2, labels[:, None, None].expand(-1, gain.shape[1], 1)).squeeze(2)
        apart = (prediction.codes[samples, :, : CODE_SIZE - 2] - wanted[:, None, : CODE_SIZE - 2]).abs().sum(2)
        return CLASS_COST * kind + BOX_COST * apart

    @torch.no_grad()
    def decode(self, prediction: QueryPrediction) -> list[Boxes3D]:
        """Boxes of each sample, best first, at most `max_boxes`: a query gives one for each class above the threshold.

        Nothing is suppressed: in training an object is one query's.
        """
        batch_size, size = prediction.valid.shape
        scores = prediction.logits.sigmoid() * prediction.valid[..., None]
        sample = torch.arange(batch_size, device=scores.device).repeat_interleave(size)
        scores, codes = scores.flatten(0, 1), prediction.codes.flatten(0, 1)
        return decode_codes(scores, codes, sample, batch_size, self.config, Suppression.maxpool)


def decode_codes(
    scores: Tensor,  # [n, 12]
    codes: Tensor,  # [n, CODE_SIZE], as in `QueryPrediction`
    sample: Tensor,  # [n] int64, ascending
    batch_size: int,
    config: DecodeConfig,
    method: Suppression,  # `maxpool`: nothing is suppressed
) -> list[Boxes3D]:
    """Boxes of each sample, best first, at most `max_boxes`: one for each row and class above the threshold."""
    best = top_candidates(scores, sample, batch_size, config.score_threshold)
    centers, log_sizes, heading, velocities = codes[best.rows].split([3, 3, 2, 2], dim=1)
    sizes, yaws = log_sizes.clamp(-LOG_SIZE_LIMIT, LOG_SIZE_LIMIT).exp(), torch.atan2(heading[:, 1], heading[:, 0])
    attributes = attributes_by_rule(velocities, centers, sizes, best.labels, ATTRIBUTE_RULES)
    boxes = Boxes3D(centers, sizes, yaws, velocities, best.labels, attributes, best.scores)
    return suppress(boxes, best.counts, method, config.max_boxes)


@torch.no_grad()
def start_codes(
    bias: Tensor,  # [CODE_SIZE], of the layer that gives box codes
) -> None:
    """Before the head has learnt any, boxes stand where their queries or points do, INITIAL_SIZE_M large, along x."""
    bias.zero_()
    bias[3:6] = torch.tensor(INITIAL_SIZE_M).log()
    bias[6] = 1.0


def box_codes(boxes: Boxes3D) -> Tensor:  # [K, CODE_SIZE], as in `QueryPrediction`
    """What a query of each box should say."""
    heading = torch.stack([boxes.yaws.cos(), boxes.yaws.sin()], dim=1)
    return torch.cat([boxes.centers, boxes.sizes.log(), heading, boxes.velocities], dim=1)
