"""Class and box of every radar point, and which object teaches it (RadarGNN)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from src.errors import ConfigError
from src.geometry.bev_grid import BEVGrid
from src.geometry.constants import constant
from src.geometry.tensor_transforms import rotate_back
from src.losses.classification import sigmoid_focal
from src.losses.normalizers import mean_over_ranks
from src.losses.regression import masked_l1
from src.models.detector import Objective
from src.models.heads.decode import Suppression
from src.models.heads.query_head import INITIAL_SIZE_M, QueryHeadConfig, box_codes, decode_codes
from src.models.layers.full_precision import FullPrecisionLinear
from src.models.radargnn.graph import PointGraph
from src.structures.boxes import Boxes3D
from src.structures.queries import SPEED_UNIT_MPS
from src.structures.taxonomy import CLASSES
from src.targets.heatmap import CODE_SIZE
from src.targets.supervision import supervised_boxes, upload_boxes

SCORE_BIAS = -4.6
"""Probability 0.01 for every point and class at the start: most returns are of no object."""


@dataclass(kw_only=True)
class PointHeadConfig(QueryHeadConfig):
    """Settings of the head (`model.head`). Raises ConfigError for impossible values."""

    nms: Suppression  # of the boxes that points of one object give
    hidden_channels: int  # of the box network; the class network is linear
    box_margin_m: float  # points so far beside a box are its own: added to its length and width in total

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.nms is Suppression.maxpool:
            raise ConfigError("model.head.nms=maxpool: works on cells, but this model's boxes are of points")
        for name, least in {"hidden_channels": 1, "box_margin_m": 0}.items():
            if not getattr(self, name) >= least:
                raise ConfigError(f"model.head.{name}={getattr(self, name)}: must be at least {least}")


@dataclass
class PointPrediction:
    """What the head says of n points."""

    graph: PointGraph
    logits: Tensor  # [n, 12] float32, columns as taxonomy.CLASSES
    codes: Tensor  # [n, CODE_SIZE] float32, relative to the points (`PointGraph.to_local`)


class PointHead(nn.Module):
    """A linear layer for the class, a network of two for the box."""

    def __init__(self, config: PointHeadConfig, channels: int, grid: BEVGrid, velocity_code_weight: float) -> None:
        super().__init__()
        self.config, self.grid = config, grid
        self.code_weights = (1.0,) * (CODE_SIZE - 2) + (velocity_code_weight,) * 2
        self.classes = FullPrecisionLinear(channels, len(CLASSES))
        hidden = config.hidden_channels
        self.box = nn.Sequential(nn.Linear(channels, hidden), nn.ReLU(), FullPrecisionLinear(hidden, CODE_SIZE))
        nn.init.constant_(self.classes.bias, SCORE_BIAS)
        with torch.no_grad():
            self.box[-1].bias.zero_()
            self.box[-1].bias[3:6] = torch.tensor(INITIAL_SIZE_M).log()
            self.box[-1].bias[6] = 1.0

    def forward(
        self,
        features: Tensor,  # [n, C]
        graph: PointGraph,
    ) -> PointPrediction:
        """Of every point."""
        shape, velocities = self.box(features).split([CODE_SIZE - 2, 2], dim=1)
        codes = torch.cat([shape, SPEED_UNIT_MPS * velocities], dim=1)
        return PointPrediction(graph, self.classes(features), codes)

    def loss(
        self,
        prediction: PointPrediction,
        boxes: list[Boxes3D] | None,  # B, augmented ego frame
        class_weight: float | None,
        box_weight: float | None,
    ) -> Objective:
        """Weighted terms `class`, focal loss of every point, and `box`, L1 of those within an object; both over the
        latter's number. A weight of None leaves its term out.

        Diagnostics, per frame: objects, and those without a point within them, which teach nothing. Raises ValueError
        for a batch without annotations.
        """
        if boxes is None:
            raise ValueError("FrameBatch.boxes is None, but a loss needs annotations")
        graph, logits = prediction.graph, prediction.logits
        objects, samples = upload_boxes(*supervised_boxes(boxes, self.grid), device=logits.device)
        owner, held = self.owners(graph, objects, samples)
        rows = (owner >= 0).nonzero().squeeze(1)
        found = mean_over_ranks((owner >= 0).sum())
        own, terms = owner[rows], {}
        if class_weight is not None:
            target = torch.zeros_like(logits, dtype=torch.bool)
            target[rows, objects.labels[own]] = True
            terms["class"] = class_weight * sigmoid_focal(logits, target).sum() / found
        if box_weight is not None:
            wanted = graph.to_local(box_codes(objects)[own], rows)
            weights = constant(self.code_weights, torch.float32, logits.device)
            errors = masked_l1(prediction.codes[rows], wanted) * weights
            terms["box"] = box_weight * errors.sum() / found
        frames = len(boxes)
        missed = (~held).sum() / frames
        return Objective(terms, {"objects": len(objects) / frames, "missed_objects": missed})

    @torch.no_grad()
    def owners(
        self,
        graph: PointGraph,
        objects: Boxes3D,  # K of all samples
        samples: Tensor,  # [K] int64
    ) -> tuple[Tensor, Tensor]:  # [n] int64, [K] bool
        """The object within whose footprint each point lies, -1 for none, the one with the nearest centre of several;
        and which objects hold a point."""
        if len(objects) == 0:
            return torch.full_like(graph.sample, -1), torch.zeros_like(objects.labels, dtype=torch.bool)
        offset = graph.points[:, None, :2] - objects.centers[:, :2]  # [n, K, 2]
        along, across = rotate_back(objects.yaws.cos(), objects.yaws.sin(), *offset.unbind(2))
        half = 0.5 * (objects.sizes[:, :2] + self.config.box_margin_m)
        inside = (along.abs() <= half[:, 0]) & (across.abs() <= half[:, 1]) & (graph.sample[:, None] == samples)
        distance, nearest = offset.square().sum(2).masked_fill(~inside, torch.inf).min(dim=1)
        return torch.where(distance.isfinite(), nearest, -1), inside.any(0)

    @torch.no_grad()
    def decode(self, prediction: PointPrediction) -> list[Boxes3D]:
        """Boxes of each sample, best first, at most `max_boxes`: what suppression leaves of one for each point and
        class above the threshold."""
        graph = prediction.graph
        codes = graph.to_frame(prediction.codes, torch.arange(len(graph.sample), device=graph.sample.device))
        scores = prediction.logits.sigmoid()
        return decode_codes(scores, codes, graph.sample, graph.batch_size, self.grid, self.config, self.config.nms)
