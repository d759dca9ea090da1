"""RadarGNN (Fent et al., CVPRW 2023): radar points as a graph, a class and a box of each point (method 13.4)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.errors import ConfigError, require_least
from src.geometry.bev_grid import BEVGrid
from src.losses.loss_weights import LossWeights
from src.models.backbones.image import ImageEncoderConfig
from src.models.detector import Detector, ModelConfig, Objective
from src.models.heads.center_head import BoxOptions
from src.models.layers.sparse import RowNorm
from src.models.radargnn.graph import GraphConfig, PointGraph, build_graph
from src.models.radargnn.head import PointHead, PointHeadConfig, PointPrediction
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D


@dataclass(kw_only=True)
class RadarGNNLossConfig(LossWeights):
    """Weights of the terms (`model.loss`); null switches a term off, uncomputed."""

    class_weight: float | None
    box_weight: float | None


@dataclass(kw_only=True)
class RadarGNNConfig(ModelConfig):
    """Settings of the model (`model`); `channels` is the width of the last layer. Raises ConfigError for values that
    cannot work."""

    graph: GraphConfig
    node_channels: list[int]  # layers of the nodes' embedding
    edge_channels: list[int]  # layers of the edges' embedding
    layer_channels: list[int]  # message-passing layers before the last
    head: PointHeadConfig
    loss: RadarGNNLossConfig

    def __post_init__(self) -> None:
        require_least(self, "model", {"channels": 1})
        for name, empty in {"node_channels": False, "edge_channels": False, "layer_channels": True}.items():
            widths = getattr(self, name)
            if not (widths or empty) or any(width < 1 for width in widths):
                raise ConfigError(f"model.{name}={widths}: must be {'' if empty else 'one or more '}positive widths")

    @property
    def sensors(self) -> tuple[str, ...]:
        """Radar alone."""
        return ("radar",)


@dataclass
class RadarGNNOutput:
    """One frame through the model."""

    head: PointPrediction


class MessagePassing(nn.Module):
    """m_i = max_j (W [x_i, x_j, e_ij] + b) over the neighbours j of i, 0 without; x_i' = ReLU(BN(U [x_i, m_i])), to
    which x_i is added where the width stays."""

    norm_pairs = (("update", "norm"),)

    def __init__(self, channels: int, edge_channels: int, out_channels: int) -> None:
        super().__init__()
        self.sizes = (channels, channels, edge_channels)
        self.message = nn.Linear(sum(self.sizes), sum(self.sizes))
        self.update = nn.Linear(channels + sum(self.sizes), out_channels, bias=False)
        self.norm = RowNorm(out_channels)

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


class GraphEncoder(nn.Module):
    """Embeds nodes and edges and passes messages along the edges."""

    def __init__(self, config: RadarGNNConfig, grid: BEVGrid) -> None:
        super().__init__()
        self.config, self.grid = config.graph, grid
        self.nodes = _mlp(config.graph.node_features, config.node_channels)
        self.edges = _mlp(config.graph.edge_features, config.edge_channels)
        widths = [config.node_channels[-1], *config.layer_channels, config.channels]
        edge = config.edge_channels[-1]
        self.layers = nn.ModuleList(MessagePassing(before, edge, after) for before, after in pairwise(widths))

    def forward(
        self,
        radar_points: Tensor,  # [P, 7] x, y, z (m, aug frame), rcs (dB), vx, vy (m/s), dt (s)
        radar_batch: Tensor,  # [P] int64 sample of each point, ascending
        batch_size: int,
    ) -> tuple[Tensor, PointGraph]:  # [n, C] and the graph of the n points it is of
        """Points outside the grid or its height band are left out."""
        low, high = self.grid.z_range_m
        inside = self.grid.contains(radar_points[:, :2]) & (radar_points[:, 2] >= low) & (radar_points[:, 2] < high)
        rows = inside.nonzero().squeeze(1)
        graph = build_graph(self.config, radar_points[rows], radar_batch[rows], batch_size)
        x, edges = self.nodes(graph.nodes), self.edges(graph.edges)
        for layer in self.layers:
            x = layer(x, edges, graph)
        return x, graph


class RadarGNN(Detector):
    """Radar points to a graph to boxes. Raises ConfigError for values that cannot work."""

    phase_options = BoxOptions
    latency_parts = {
        "radar_encoder": ("radar_encoder.forward",),
        "detection_head": ("head.forward", "head.decode"),
    }

    def __init__(
        self, config: RadarGNNConfig, grid: BEVGrid, backbone: ImageEncoderConfig | None, options: BoxOptions
    ) -> None:
        super().__init__()
        self.config, self.grid = config, grid
        self.radar_encoder = GraphEncoder(config, grid)
        self.head = PointHead(config.head, config.channels, grid, options.velocity_code_weight)

    def forward(self, batch: FrameBatch, memory: None = None) -> tuple[RadarGNNOutput, None]:
        """Detect in B frames."""
        features, graph = self.radar_encoder(batch.radar_points, batch.radar_batch, len(batch))
        return RadarGNNOutput(self.head(features, graph)), None

    def loss_terms(self, output: RadarGNNOutput, batch: FrameBatch) -> Objective:
        """Weighted terms `class` and `box`."""
        weights = self.config.loss
        return self.head.loss(output.head, batch.boxes, weights.class_weight, weights.box_weight)

    def decode(self, output: RadarGNNOutput) -> list[Boxes3D]:
        """Boxes of each frame, best first."""
        return self.head.decode(output.head)

    def diagnostics(self, output: RadarGNNOutput) -> dict[str, Tensor | float]:
        """Radar points per frame."""
        graph = output.head.graph
        return {"radar_points": len(graph.points) / graph.batch_size}


def _mlp(inputs: int, widths: list[int]) -> nn.Sequential:
    """Linear layers with ReLU between them."""
    layers = [part for pair in pairwise([inputs, *widths]) for part in (nn.Linear(*pair), nn.ReLU())]
    return nn.Sequential(*layers[:-1])
