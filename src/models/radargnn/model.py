"""RadarGNN (Fent et al., CVPRW 2023): radar points as a graph, a class and a box of each point (method 13.4)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.errors import ConfigError, require_least
from src.geometry.bev_grid import BEVGrid
from src.geometry.box_distance import footprint_distances
from src.geometry.constants import constant
from src.losses.classification import sigmoid_focal
from src.losses.loss_weights import LossWeights
from src.losses.normalizers import mean_over_ranks
from src.losses.regression import masked_l1
from src.models.backbones.image import ImageEncoderConfig
from src.models.detector import Detector, ModelConfig, Objective
from src.models.heads.center_head import BoxOptions, code_weights
from src.models.heads.decode import DecodeConfig, Suppression
from src.models.heads.query_head import box_codes, decode_codes, start_codes
from src.models.layers.full_precision import FullPrecisionLinear
from src.models.layers.sparse import RowBatchNorm
from src.models.radargnn.graph import GraphConfig, PointGraph, build_graph
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from src.structures.taxonomy import CLASSES, SPEED_UNIT_MPS
from src.targets.heatmap import CODE_SIZE
from src.targets.supervision import supervised_boxes, upload_boxes

SCORE_BIAS = -4.6
"""Probability 0.01 for every point and class at the start: most returns are of no object."""


@dataclass(kw_only=True)
class PointHeadConfig(DecodeConfig):
    """Settings of the head (`model.head`). Raises ConfigError for impossible values."""

    nms: Suppression  # of the boxes that points of one object give
    hidden_channels: int  # of the box network; the class network is linear

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.nms is Suppression.maxpool:
            raise ConfigError("model.head.nms=maxpool: works on cells, but this model's boxes are of points")
        require_least(self, "model.head", {"hidden_channels": 1})


@dataclass(kw_only=True)
class RadarGNNLossConfig(LossWeights):
    """Weights of the terms (`model.loss`); null switches a term off, uncomputed."""

    class_weight: float | None
    box_weight: float | None


@dataclass(kw_only=True)
class RadarGNNConfig(ModelConfig):
    """Settings of the model (`model`); `channels` is that of the last layer. Raises ConfigError for impossible ones."""

    sensors: ClassVar[tuple[str, ...]] = ("radar",)

    graph: GraphConfig
    node_channels: list[int]  # layers of the nodes' embedding
    edge_channels: list[int]  # layers of the edges' embedding
    layer_channels: list[int]  # message-passing layers before the last
    head: PointHeadConfig
    loss: RadarGNNLossConfig

    def __post_init__(self) -> None:
        require_least(self, "model", {"channels": 1})
        for name in ("node_channels", "edge_channels", "layer_channels"):
            if min(getattr(self, name), default=0) < 1:
                raise ConfigError(f"model.{name}={getattr(self, name)}: must be one or more positive widths")


@dataclass
class PointPrediction:
    """What the head says of n points."""

    graph: PointGraph
    logits: Tensor  # [n, 12] float32, columns as taxonomy.CLASSES
    codes: Tensor  # [n, CODE_SIZE] float32, relative to the points (`PointGraph.to_local`)


@dataclass
class RadarGNNOutput:
    """One frame through the model."""

    head: PointPrediction


class MessagePassing(nn.Module):
    """m_i = max_j (W [x_i, x_j, e_ij] + b) over the neighbours j of i, 0 without; x_i' = ReLU(BN(U [x_i, m_i])), to
    which x_i is added where the width stays."""

    norm_pairs = (("update", "norm"),)

    def __init__(self, channels: int, out_channels: int, edge_channels: int) -> None:
        super().__init__()
        self.sizes = (channels, channels, edge_channels)
        self.message = nn.Linear(sum(self.sizes), sum(self.sizes))
        self.update = nn.Linear(channels + sum(self.sizes), out_channels, bias=False)
        self.norm = RowBatchNorm(out_channels)

    def forward(
        self,
        x: Tensor,  # [n, C]
        edges: Tensor,  # [n, k, E]
        graph: PointGraph,
    ) -> Tensor:  # [n, C']
        """New features of every point."""
        new = F.relu(self.norm(self.update(torch.cat([x, self.aggregate(x, edges, graph)], dim=1))))
        return new + x if new.shape == x.shape else new

    def aggregate(self, x: Tensor, edges: Tensor, graph: PointGraph) -> Tensor:  # [n, 2 C + E]
        """m of every point. As the message is linear, W_i x_i stands outside the maximum, and W_j x_j is computed once
        a point, not once an edge."""
        own, other, edge = self.message.weight.split(self.sizes, dim=1)
        messages = F.embedding(graph.neighbours, F.linear(x, other)) + F.linear(edges, edge)  # [n, k, 2 C + E]
        most = messages.masked_fill(~graph.present[..., None], -torch.inf).max(dim=1).values
        return torch.where(graph.present.any(1, keepdim=True), F.linear(x, own, self.message.bias) + most, 0.0)


class PointHead(nn.Module):
    """A linear layer for the class, a network of two for the box."""

    def __init__(self, config: PointHeadConfig, channels: int, grid: BEVGrid, velocity_code_weight: float) -> None:
        super().__init__()
        self.config, self.grid = config, grid
        self.code_weights = code_weights(velocity_code_weight)
        hidden, self.classes = config.hidden_channels, FullPrecisionLinear(channels, len(CLASSES))
        self.box = nn.Sequential(nn.Linear(channels, hidden), nn.ReLU(), FullPrecisionLinear(hidden, CODE_SIZE))
        nn.init.constant_(self.classes.bias, SCORE_BIAS)
        start_codes(self.box[-1].bias)

    def forward(
        self,
        features: Tensor,  # [n, C]
        graph: PointGraph,
    ) -> PointPrediction:
        """Class and box of every point."""
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
        graph, logits = prediction.graph, prediction.logits
        objects, samples = upload_boxes(*supervised_boxes(boxes, self.grid), device=logits.device)
        owner, held = self.owners(graph, objects, samples)
        rows = (owner >= 0).nonzero().squeeze(1)
        own, terms, found = owner[rows], {}, mean_over_ranks((owner >= 0).sum())
        if class_weight is not None:
            target = torch.zeros_like(logits, dtype=torch.bool)
            target[rows, objects.labels[own]] = True
            terms["class"] = class_weight * sigmoid_focal(logits, target).sum() / found
        if box_weight is not None:
            wanted = graph.to_local(box_codes(objects)[own], rows)
            weights = constant(self.code_weights, torch.float32, logits.device)
            errors = masked_l1(prediction.codes[rows], wanted) * weights
            terms["box"] = box_weight * errors.sum() / found
        return Objective(terms, {"objects": len(objects) / len(boxes), "missed_objects": (~held).sum() / len(boxes)})

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
        inside = (footprint_distances(graph.points[:, :2], objects.bev()) == 0) & (graph.sample[:, None] == samples)
        distance, nearest = offset.square().sum(2).masked_fill(~inside, torch.inf).min(dim=1)
        return torch.where(distance.isfinite(), nearest, -1), inside.any(0)

    @torch.no_grad()
    def decode(self, prediction: PointPrediction) -> list[Boxes3D]:
        """Boxes of each sample, best first, at most `max_boxes`: what suppression leaves of one for each point and
        class above the threshold."""
        graph, scores = prediction.graph, prediction.logits.sigmoid()
        codes = graph.to_frame(prediction.codes, slice(None))
        return decode_codes(scores, codes, graph.sample, graph.batch_size, self.config, self.config.nms)


class RadarGNN(Detector):
    """Radar points to a graph to boxes. Raises ConfigError for values that cannot work."""

    phase_options = BoxOptions
    latency_parts = {"radar_encoder": ("encode",), "detection_head": ("head.forward", "head.decode")}

    def __init__(
        self, config: RadarGNNConfig, grid: BEVGrid, backbone: ImageEncoderConfig | None, options: BoxOptions
    ) -> None:
        super().__init__()
        self.config, self.grid = config, grid
        node, edge = config.graph.widths
        self.nodes, self.edges = _mlp(node, config.node_channels), _mlp(edge, config.edge_channels)
        widths = [config.node_channels[-1], *config.layer_channels, config.channels]
        self.layers = nn.ModuleList(MessagePassing(*pair, config.edge_channels[-1]) for pair in pairwise(widths))
        self.head = PointHead(config.head, config.channels, grid, options.velocity_code_weight)

    def forward(self, batch: FrameBatch, memory: None = None) -> tuple[RadarGNNOutput, None]:
        """Detect in B frames. Points outside the grid or its height band are left out."""
        return RadarGNNOutput(self.head(*self.encode(batch))), None

    def encode(self, batch: FrameBatch) -> tuple[Tensor, PointGraph]:  # [n, C]
        """Features of the n points inside, and their graph."""
        points = batch.radar_points
        rows = self.grid.contains_points(points).nonzero().squeeze(1)
        graph = build_graph(self.config.graph, points[rows], batch.radar_batch[rows], len(batch))
        x, edges = self.nodes(graph.nodes), self.edges(graph.edges)
        for layer in self.layers:
            x = layer(x, edges, graph)
        return x, graph

    def loss_terms(self, output: RadarGNNOutput, batch: FrameBatch) -> Objective:
        """Weighted terms `class` and `box`."""
        weights = self.config.loss
        return self.head.loss(output.head, batch.boxes, weights.class_weight, weights.box_weight)

    def diagnostics(self, output: RadarGNNOutput) -> dict[str, Tensor | float]:
        """Radar points per frame."""
        return {"radar_points": len(output.head.logits) / output.head.graph.batch_size}


def _mlp(inputs: int, widths: list[int]) -> nn.Sequential:
    """Linear layers with ReLU between them."""
    layers = [part for pair in pairwise([inputs, *widths]) for part in (nn.Linear(*pair), nn.ReLU())]
    return nn.Sequential(*layers[:-1])
