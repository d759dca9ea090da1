"""Queries that begin near true objects, in training alone, and say where these are (DN-DETR's idea as in StreamPETR).

They need no assignment, so they teach the decoder to look and to refine from the first step on.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from src.errors import ConfigError, require_least
from src.geometry.bev_grid import BEVGrid
from src.geometry.tensor_transforms import rotate
from src.losses.classification import sigmoid_focal
from src.losses.normalizers import mean_over_ranks
from src.models.heads.query_head import QueryPrediction, SetPredictionHead, box_codes
from src.structures.boxes import Boxes3D
from src.structures.queries import Queries
from src.targets.supervision import supervised_boxes, upload_boxes


@dataclass(kw_only=True)
class DenoisingConfig:
    """Settings of denoising (`model.denoising`). Raises ConfigError for values that cannot work."""

    num_groups: int  # of a query for each object; no group sees another
    extent: float  # of the noise, in half sizes of the box along its axes
    background_from: float  # noise longer than this share of the extent makes the query one of no object

    def __post_init__(self) -> None:
        require_least(self, "model.denoising", {"num_groups": 1, "extent": 0, "background_from": 0})
        if self.extent == 0:
            raise ConfigError("model.denoising.extent=0: must be above 0; model.loss.denoising_weight=null is without")


@dataclass
class NoisyQueries:
    """The queries of all groups side by side, padded to the frame with most objects, and what they should say."""

    queries: Queries  # [B, n]
    labels: Tensor  # [B, n] int64
    codes: Tensor  # [B, n, CODE_SIZE]
    foreground: Tensor  # [B, n] bool, the object's class rather than none


def noisy_queries(
    config: DenoisingConfig,
    boxes: list[Boxes3D],  # B, augmented ego frame
    grid: BEVGrid,
    channels: int,
    device: torch.device,
) -> NoisyQueries:
    """For each object and group a query within its box, drawn from torch's generator, of no known class, standing."""
    objects, samples = supervised_boxes(boxes, grid)
    counts = torch.bincount(samples, minlength=len(boxes))
    size, every = int(counts.max()), torch.arange(len(samples))
    rows = torch.full((len(boxes), size), -1)
    rows[samples, every - (counts.cumsum(0) - counts)[samples]] = every
    objects, rows = upload_boxes(objects, rows, device=device)
    rows = rows.repeat(1, config.num_groups)  # [B, n]
    valid, picks = rows >= 0, rows.clamp(min=0)
    noise = 2 * torch.rand(*rows.shape, 3, device=device) - 1
    shift = 0.5 * config.extent * noise * objects.sizes[picks]
    cos, sin = objects.yaws[picks].cos(), objects.yaws[picks].sin()
    turned = torch.stack(rotate(cos, sin, shift[..., 0], shift[..., 1]), dim=-1)
    centers = objects.centers[picks] + torch.cat([turned, shift[..., 2:]], dim=-1)
    queries = Queries.unknown(centers.new_zeros(*rows.shape, channels), centers, valid)
    groups = torch.arange(1, config.num_groups + 1, device=device).repeat_interleave(size)
    queries = replace(queries, groups=groups.expand_as(rows))
    foreground = valid & (noise.norm(dim=-1) <= config.background_from)
    return NoisyQueries(queries, objects.labels[picks], box_codes(objects)[picks], foreground)


def denoising_loss(
    noisy: NoisyQueries,
    predictions: list[QueryPrediction],  # of each layer, of these queries
    head: SetPredictionHead,
    class_weight: float | None,
    box_weight: float | None,
) -> Tensor:  # []
    """Focal loss over the queries of an object's class and L1 of all boxes over all of them, summed over layers."""
    valid, total = noisy.queries.valid, noisy.codes.new_zeros(())
    target = torch.zeros_like(predictions[0].logits, dtype=torch.bool)
    target.scatter_(2, noisy.labels[..., None], noisy.foreground[..., None])
    for prediction in predictions:
        if class_weight is not None:
            focal = (sigmoid_focal(prediction.logits, target) * valid[..., None]).sum()
            total = total + class_weight * focal / mean_over_ranks(noisy.foreground.sum())
        if box_weight is not None:
            errors = head.code_errors(prediction.codes[valid], noisy.codes[valid])
            total = total + box_weight * errors.sum() / mean_over_ranks(valid.sum())
    return total
