"""What is learnt from LiDAR rays alone: L_occ and L_velo of the volume (lrs 6.2), L1 of the ray head (lrs 6.3)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from src.errors import require_least
from src.geometry.bounds import Bounds
from src.losses.loss_weights import LossWeights
from src.losses.normalizers import any_over_ranks, full_precision, mean_over_ranks
from src.losses.regression import masked_smooth_l1
from src.models.detector import Objective
from src.structures.ray_bundle import RayBundle
from src.structures.taxonomy import MOVING_MPS
from src.targets.occupancy_rays import RaySampling, draw_rays, sample_queries

Answer = Callable[[Tensor, Tensor], tuple[Tensor, Tensor | None]]
"""Queries [Q, 4] and their samples [Q] to logits [Q] and radial velocities [Q] m/s."""


@dataclass(kw_only=True)
class LRSLossConfig(LossWeights):
    """Weights of the terms (`model.loss`), null switches a term off, uncomputed; and what is drawn to compute them."""

    heatmap_weight: float | None
    box_weight: float | None
    occupancy_weight: float  # w_o
    velocity_weight: float | None  # w_v
    velocity_beta_mps: float  # errors below it count by their square, e^2 / (2 beta): 0 for a plain L1
    moving_weight: float  # of the error of what is measured to move faster than MOVING_MPS, within the mean
    range_weight: float
    rays_per_frame: int  # rays of each sample and target time that the ray head learns from
    ray_range_power: float  # they are drawn with chances in proportion to their ranges to this power
    sampling: RaySampling

    def __post_init__(self) -> None:
        super().__post_init__()
        least = {"rays_per_frame": 1, "ray_range_power": 0, "moving_weight": 1, "velocity_beta_mps": 0}
        require_least(self, "model.loss", least)


def occupancy_objective(answer: Answer, rays: RayBundle, bounds: Bounds, config: LRSLossConfig) -> Objective:
    """Weighted terms `occupancy` and `velocity`, each a mean over its queries (eq. 14 and 15, O20), in the second what
    moves with a weight of its own.

    A free query has speed 0. Where no return of the batch has a known speed these alone would teach that everything
    stands, so the term is 0.
    """
    queries = sample_queries(rays, bounds, config.sampling)
    logits, speeds = answer(torch.cat([queries.points, queries.times_s[:, None]], dim=1), queries.batch)
    entropy = F.binary_cross_entropy_with_logits(full_precision(logits), queries.occupied.float(), reduction="none")
    count = mean_over_ranks(torch.as_tensor(len(logits), device=logits.device))
    terms = {"occupancy": config.occupancy_weight * entropy.sum() / count}
    found, known = logits.detach() > 0, queries.occupied & ~queries.speeds.isnan()
    counts = {
        "iou": (found & queries.occupied).sum() / (found | queries.occupied).sum().clamp(min=1),
        "known_speeds": known.sum() / queries.occupied.sum().clamp(min=1),
    }
    if config.velocity_weight is not None and speeds is not None:
        weights = 1 + (config.moving_weight - 1) * (queries.speeds.abs() > MOVING_MPS)
        errors = weights * masked_smooth_l1(speeds, queries.speeds, config.velocity_beta_mps)
        valid = mean_over_ranks(weights[~queries.speeds.isnan()].sum())
        terms["velocity"] = config.velocity_weight * any_over_ranks(known.any()) * errors.sum() / valid
    return Objective(terms, counts)


def range_objective(
    ray_ranges: Callable[[RayBundle], Tensor], rays: RayBundle, bounds: Bounds, config: LRSLossConfig
) -> Objective:
    """The weighted term `range`: L1 between ranges, of rays that end in the bounds."""
    drawn = draw_rays(rays, bounds, config.rays_per_frame, range_power=config.ray_range_power)
    errors = (full_precision(ray_ranges(drawn)) - drawn.ranges).abs()
    count = mean_over_ranks(torch.as_tensor(len(drawn), device=errors.device))
    return Objective({"range": config.range_weight * errors.sum() / count}, {})
