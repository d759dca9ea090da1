"""The objective L = L_det + lambda_kggi L_kggi + lambda_ocsf L_ocsf + lambda_dptf L_dptf (Eq. 10) by named terms."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import ClassVar

import torch
from torch import Tensor

from src.losses.classification import sigmoid_focal
from src.losses.loss_weights import LossWeights
from src.losses.normalizers import mean_over_ranks
from src.losses.regression import masked_l1, masked_smooth_l1
from src.losses.segmentation import dice, lovasz_foreground, occupancy_losses
from src.models.heads.keypoint_head import camera_losses
from src.models.horizon3d.bev_path import CellPrediction
from src.models.horizon3d.kggi import KGGIConfig, KGGIOutput
from src.models.horizon3d.ocsf import OCSFOutput
from src.models.layers.views import CameraViews
from src.structures.sparse_bev import SparseBEV
from src.structures.taxonomy import MOVING_MPS
from src.targets.box_raster import BoxRaster
from src.targets.projection import view_boxes


class VelocityGroups(Enum):
    """Over what velocity errors are averaged; means of several groups are added.

    `boxes`: all that lies in boxes, where moving ones have 95 % of the cells. `motion`: what moves, and what stands.
    `motion_and_ground`: these, and what lies outside all boxes, which stands.
    """

    boxes = "boxes"
    motion = "motion"
    motion_and_ground = "motion_and_ground"


@dataclass(kw_only=True)
class Horizon3DLossConfig(LossWeights):
    """Weights of the terms (`model.loss`); an inner weight of null switches its term off, uncomputed."""

    factors: ClassVar[tuple[str, ...]] = ("kggi_weight", "ocsf_weight", "dptf_weight")

    kggi_weight: float  # lambda_kggi, on keypoint, depth and radar objectness
    ocsf_weight: float  # lambda_ocsf, on the two occupancy terms
    dptf_weight: float  # lambda_dptf, on the four cell terms and the Gaussian velocities
    heatmap_weight: float | None
    box_weight: float | None
    keypoint_weight: float | None
    depth_weight: float | None
    radar_objectness_weight: float | None
    occupancy_focal_weight: float | None
    occupancy_dice_weight: float | None
    cell_focal_weight: float | None
    cell_dice_weight: float | None
    cell_lovasz_weight: float | None
    cell_velocity_weight: float | None
    gaussian_velocity_weight: float | None
    velocity_groups: VelocityGroups  # of cells and of Gaussians
    gaussian_velocity_in_phase1: bool  # supervise Gaussian velocities (Eq. 9) already without memory


def kggi_losses(
    kggi: KGGIOutput,
    radar_bev: SparseBEV,
    views: CameraViews,
    raster: BoxRaster,
    settings: KGGIConfig,
    config: Horizon3DLossConfig,
) -> dict[str, Tensor]:
    """2D keypoints, depth and radar objectness (method 4.1, 4.3), weighted; {} without keypoint heads."""
    terms: dict[str, Tensor] = {}
    if kggi.camera is None or kggi.objectness_logits is None:
        return terms
    if config.radar_objectness_weight is not None:
        target = raster.in_boxes(radar_bev.sites.linear())  # [M] bool
        total = sigmoid_focal(kggi.objectness_logits, target).sum()
        terms["radar_objectness"] = config.radar_objectness_weight * total / mean_over_ranks(target.sum())
    if config.keypoint_weight is None and config.depth_weight is None:
        return _times(terms, config.kggi_weight)

    seen = view_boxes(raster.boxes, raster.sample, views.pix_from_aug, views.valid, views.image_size_px)
    weights = (config.keypoint_weight, config.depth_weight)
    terms |= camera_losses(kggi.camera, views, seen, settings.depth_range, *weights)
    return _times(terms, config.kggi_weight)


def ocsf_losses(
    ocsf: OCSFOutput,
    raster: BoxRaster,
    config: Horizon3DLossConfig,
) -> dict[str, Tensor]:
    """Occupancy of the splat against the enlarged boxes (method 5.6), weighted."""
    terms: dict[str, Tensor] = {}
    if config.occupancy_focal_weight is not None or config.occupancy_dice_weight is not None:
        cells = ocsf.splat.cells
        batch_size, *plane = cells.occupied.shape
        focal, dice = occupancy_losses(cells.log_free, cells.support, raster.keys, batch_size, math.prod(plane))
        if config.occupancy_focal_weight is not None:
            normalizer = mean_over_ranks(raster.keys.new_full((), len(raster.keys)))
            terms["occupancy_focal"] = config.occupancy_focal_weight * focal / normalizer
        if config.occupancy_dice_weight is not None:
            terms["occupancy_dice"] = config.occupancy_dice_weight * dice
    return _times(terms, config.ocsf_weight)


def gaussian_velocity_loss(
    ocsf: OCSFOutput,
    raster: BoxRaster,
    config: Horizon3DLossConfig,
) -> dict[str, Tensor]:
    """Velocities of Gaussians against the enlarged box at the cell where each contributes most (Eq. 9), weighted."""
    if config.gaussian_velocity_weight is None:
        return {}
    cells = ocsf.splat.peak_cells.flatten()
    target = raster.velocities_in_margins(cells)  # [B*G, 2]
    target, group = _velocity_groups(target, cells, raster, config.velocity_groups)
    errors = masked_smooth_l1(ocsf.loss_velocities.flatten(0, 1), target)
    value = config.gaussian_velocity_weight * _sum_of_means(errors, target, group)
    return _times({"gaussian_velocity": value}, config.dptf_weight)


def cell_losses(
    cells: CellPrediction,
    fused: SparseBEV,
    raster: BoxRaster,  # with margins, in which nothing says whether a cell moves
    config: Horizon3DLossConfig,
) -> dict[str, Tensor]:
    """Occupancy and velocity of the cells of F_fuse against the tight boxes (method 6.1, 8.1), weighted."""
    terms: dict[str, Tensor] = {}
    keys, sample = fused.sites.linear(), fused.indices[:, 0]
    target = raster.in_boxes(keys)  # [M]
    if config.cell_focal_weight is not None:
        total = sigmoid_focal(cells.occupancy_logits, target).sum()
        terms["cell_focal"] = config.cell_focal_weight * total / mean_over_ranks(target.sum())
    score = cells.occupancy_logits.sigmoid()
    if config.cell_dice_weight is not None:
        terms["cell_dice"] = config.cell_dice_weight * dice(score, target, sample, fused.batch_size)
    if config.cell_lovasz_weight is not None:
        terms["cell_lovasz"] = config.cell_lovasz_weight * lovasz_foreground(score, target, sample, fused.batch_size)
    if config.cell_velocity_weight is not None:
        wanted = raster.velocities_in_boxes(keys)  # [M, 2]
        wanted, group = _velocity_groups(wanted, keys, raster, config.velocity_groups)
        errors = masked_l1(cells.loss_velocities, wanted)
        terms["cell_velocity"] = config.cell_velocity_weight * _sum_of_means(errors, wanted, group)
    return _times(terms, config.dptf_weight)


def _velocity_groups(
    target: Tensor,  # [n, 2] m/s, NaN where unknown and outside the boxes
    cells: Tensor,  # [n] int64 linear keys; -1 for none
    raster: BoxRaster,
    groups: VelocityGroups,
) -> tuple[Tensor, Tensor]:  # [n, 2], [n] int64 group
    """The target, zero on open ground if that is a group: 0 stands or is not told apart, 1 moves, 2 is ground."""
    group = torch.zeros_like(cells)
    if groups is not VelocityGroups.boxes:
        group = (target.norm(dim=1) > MOVING_MPS).long()  # not of NaN, whose errors are 0 and not counted
    if groups is VelocityGroups.motion_and_ground:
        ground = raster.on_open_ground(cells)
        target = torch.where(ground[:, None], 0.0, target)
        group = torch.where(ground, 2, group)
    return target, group


def _sum_of_means(
    errors: Tensor,  # [n, 2]
    target: Tensor,  # [n, 2], NaN where unknown
    group: Tensor,  # [n] int64 in 0..2
) -> Tensor:  # []
    """Sum over the groups of their mean error over known components."""
    zeros = errors.new_zeros(3)
    counts = zeros.index_add(0, group, (~target.isnan()).sum(1).to(zeros.dtype))
    return (zeros.index_add(0, group, errors.sum(1)) / mean_over_ranks(counts)).sum()


def _times(terms: dict[str, Tensor], weight: float) -> dict[str, Tensor]:
    return {name: weight * value for name, value in terms.items()}
