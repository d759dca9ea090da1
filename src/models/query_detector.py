"""What detectors whose boxes come from object queries have in common (method 13.2, 13.3)."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from src.errors import ConfigError
from src.geometry.bev_grid import BEVGrid
from src.geometry.constants import where_scalar
from src.losses.loss_weights import LossWeights
from src.models.backbones.image import ImageEncoder, ImageEncoderConfig
from src.models.detector import Detector, ModelConfig, Objective
from src.models.heads.center_head import BoxOptions
from src.models.heads.decode import DecodeConfig
from src.models.heads.keypoint_head import CameraMaps, camera_losses
from src.models.heads.query_head import QueryPrediction, SetPredictionHead
from src.models.layers.views import CameraViews
from src.models.query_denoising import DenoisingConfig, NoisyQueries, denoising_loss, noisy_queries
from src.models.query_memory import QueryMemory, QueryMemoryConfig, QueryPropagation, RecalledQueries
from src.structures.batch import FrameBatch
from src.structures.evidence import Evidence
from src.structures.queries import Queries
from src.targets.projection import view_boxes
from src.targets.supervision import supervised_boxes, upload_boxes


@dataclass(kw_only=True)
class QueryLossConfig(LossWeights):
    """Weights of the terms (`model.loss`); null switches a term off, uncomputed."""

    class_weight: float | None  # of every layer's queries
    box_weight: float | None
    denoising_weight: float | None  # of both for queries near true objects


@dataclass(kw_only=True)
class CameraQueryLossConfig(QueryLossConfig):
    """Weights of the terms of a model that also finds objects in the images."""

    keypoint_weight: float | None  # of the images
    depth_weight: float | None


@dataclass(kw_only=True)
class QueryDetectorConfig(ModelConfig):
    """Settings of the model (`model`). Raises ConfigError for parts that do not go together."""

    temporal_part: ClassVar[str] = "temporal"
    new_in_temporal_phase: ClassVar[str] = r"temporal\."
    sensors: ClassVar[tuple[str, ...]] = ("camera", "radar")

    temporal: QueryMemoryConfig | None  # null: single frames, phase 1
    denoising: DenoisingConfig
    head: DecodeConfig
    loss: QueryLossConfig

    @property
    def image_strides_px(self) -> tuple[int, ...] | None:
        """Levels of the image pyramid that are used; None: all that the neck offers."""
        return None


@dataclass
class QueryOutput:
    """One frame through the model."""

    layers: list[QueryPrediction]  # of the decoder
    head: QueryPrediction  # of the layer that boxes are taken from
    recalled: RecalledQueries | None  # None in phase 1
    denoised: Denoised | None  # in training


class Denoised(NamedTuple):
    """Queries that began near true objects, and what each layer says to them."""

    noisy: NoisyQueries
    layers: list[QueryPrediction]


class QueryDetector(Detector):
    """An image encoder, what the family sees and asks, a decoder of queries, and the best of them remembered.

    Raises ConfigError when parts, grid and backbone do not fit.
    """

    phase_options = BoxOptions
    memory_type = QueryMemory
    latency_parts = {
        "image_encoder": ("image_encoder.forward",),
        "temporal_fusion": ("temporal.recall", "temporal.remember"),
        "detection_head": ("decoder.forward", "head.decode"),
    }

    def __init__(
        self, config: QueryDetectorConfig, grid: BEVGrid, backbone: ImageEncoderConfig | None, options: BoxOptions
    ) -> None:
        super().__init__()
        if backbone is None:
            raise ConfigError(f"backbone=null: the queries of model={config.name} look at images; choose a backbone")
        self.config, self.grid = config, grid
        self.image_encoder = ImageEncoder(backbone, config.image_strides_px)
        self.build()
        past = config.temporal
        self.temporal = QueryPropagation(past, config.channels, grid) if past is not None else None
        self.head = SetPredictionHead(config.head, config.channels, grid, options.velocity_code_weight)

    @abstractmethod
    def build(self) -> None:
        """Make `decoder`, called with queries, further ones to look at, what is seen and the head, and what lies
        before it."""

    def add_anchors(self, count: int, learnt_features: bool = False) -> None:
        """Make the learnt places that `anchor_queries` start at, with features of their own or with zeros."""
        # In units of the half extent, so that one step of Adam is of the order of a metre; uniform at first (PETR 3.4).
        self.anchors = nn.Parameter(torch.empty(count, 3).uniform_(-1.0, 1.0))
        (low, high), z = self.grid.z_range_m, sum(self.grid.z_range_m) / 2
        extent = torch.tensor([(*self.grid.centre_m, z), (*self.grid.half_extent_m, (high - low) / 2)])
        self.register_buffer("extent_m", extent, persistent=False)
        self.anchor_features = nn.Parameter(torch.randn(count, self.config.channels)) if learnt_features else None

    def anchor_queries(self, batch_size: int) -> Queries:
        """Queries at the learnt anchors."""
        middle, half = self.extent_m.unbind(0)
        centers = (middle + half * self.anchors).expand(batch_size, -1, -1)
        if self.anchor_features is None:
            features = centers.new_zeros(*centers.shape[:2], self.config.channels)
        else:
            features = self.anchor_features.expand(batch_size, -1, -1)
        return Queries.unknown(features, centers, torch.ones_like(centers[..., 0], dtype=torch.bool))

    @property
    def output_layer(self) -> int:
        """The decoder's layer whose boxes count and whose queries are remembered."""
        return -1

    def run_decoder(
        self,
        batch: FrameBatch,
        memory: QueryMemory | None,
        queries: Queries,  # of this frame
        *seen: Any,  # as the decoder takes it
    ) -> tuple[QueryOutput, QueryMemory | None]:
        """What the decoder says to these queries and those of the last frame, and the memory with this frame, detached.

        Raises ValueError for a memory of another number of streams.
        """
        recalled, older, denoised = None, None, None
        if self.temporal is not None:
            recalled = self.temporal.recall(memory, batch)
            queries, older = Queries.concatenate([queries, recalled.newest], dim=1), recalled.older
        count, noisy, wanted = len(queries), None, self.config.loss.denoising_weight is not None
        if wanted and self.training and torch.is_grad_enabled() and batch.boxes is not None:
            noisy = noisy_queries(self.config.denoising, batch.boxes, self.grid, self.config.channels, batch.device)
            queries = queries.beside(noisy.queries)
        layers, features = self.decoder(queries, older, *seen, self.head)
        if noisy is not None:
            layers, others = zip(*(layer.split(count) for layer in layers), strict=True)
            denoised = Denoised(noisy, list(others))
        output = QueryOutput(list(layers), layers[self.output_layer], recalled, denoised)
        if self.temporal is None:
            return output, None
        own = features[self.output_layer][:, :count]
        return output, self.temporal.remember(recalled.past, batch, own, output.head)

    def loss_terms(self, output: QueryOutput, batch: FrameBatch) -> Objective:
        """Weighted terms `class` and `box`, and in training `denoising`."""
        weights = self.config.loss
        terms, counts = self.head.loss(output.layers, batch.boxes, weights.class_weight, weights.box_weight)
        if output.denoised is not None:
            loss = denoising_loss(*output.denoised, self.head, weights.class_weight, weights.box_weight)
            terms["denoising"] = weights.denoising_weight * loss
        return Objective(terms, counts)

    def camera_terms(
        self, maps: CameraMaps, views: CameraViews, depth_range_m: tuple[float, float], batch: FrameBatch
    ) -> dict[str, Tensor]:
        """Weighted terms `keypoint` and `depth`, of a model with `CameraQueryLossConfig`."""
        wanted = (self.config.loss.keypoint_weight, self.config.loss.depth_weight)
        if wanted == (None, None):
            return {}
        boxes, samples = upload_boxes(*supervised_boxes(batch.boxes, self.grid), device=batch.device)
        seen = view_boxes(boxes, samples, views.pix_from_aug, views.valid, views.image_size_px)
        return camera_losses(maps, views, seen, depth_range_m, *wanted)

    def diagnostics(self, output: QueryOutput) -> dict[str, Tensor | float]:
        """Queries and what is remembered, per frame; by how much the queries of a frame differ in their logits.

        Where that is next to nothing the decoder has collapsed: all say the same, wherever they look.
        """
        valid = output.head.valid
        values = {
            "queries": valid.sum() / len(valid),
            "logit_spread": masked_std(output.head.logits.detach(), valid).mean(),
        }
        return values if output.recalled is None else values | output.recalled.diagnostics()

    def evidence(self, output: QueryOutput) -> Evidence:
        """Where remembered queries of the first sample are now."""
        return Evidence() if output.recalled is None else output.recalled.evidence()


def masked_std(
    values: Tensor,  # [B, Q, C]
    valid: Tensor,  # [B, Q] bool
) -> Tensor:  # [B, C]
    """Standard deviation over the valid queries of each sample, 0 where there are none."""
    kept = valid[..., None]
    count = kept.sum(dim=1, keepdim=True).clamp(min=1)
    mean = where_scalar(kept, values, 0.0).sum(dim=1, keepdim=True) / count
    return (where_scalar(kept, values - mean, 0.0).square().sum(dim=1) / count.squeeze(1)).sqrt()
