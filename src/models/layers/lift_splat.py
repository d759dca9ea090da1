"""Lift-splat: pixels spread along their rays by a predicted depth, summed into BEV cells (method 13)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from src.errors import ConfigError, require_least
from src.geometry.bev_grid import BEVGrid
from src.geometry.tensor_transforms import pixel_centres
from src.models.backbones.resnet import BasicBlock
from src.models.layers.dense import DenseConvNormReLU, MapConv2d, map_of_rows, rows_of_map
from src.models.layers.views import CameraViews
from src.ops.segment_reduce import inverse_rows, weighted_segment_sum
from src.structures.batch import FrameBatch
from src.targets.depth import DepthBinsConfig, lid_centres, paint_depth
from src.targets.projection import view_boxes
from src.targets.supervision import supervised_boxes, upload_boxes


@dataclass(kw_only=True)
class LiftSplatConfig(DepthBinsConfig):
    """Settings of the view transform (`model.view_transform`). Raises ConfigError for values that cannot work."""

    image_stride_px: int  # level of the image encoder that is lifted
    hidden_channels: int  # of the depth network
    context_channels: int  # width of what is lifted, and of the map
    z_range_m: list[float]  # [low, high): lifted points outside are dropped

    def __post_init__(self) -> None:
        own = ("image_stride_px", "hidden_channels", "context_channels")
        require_least(self, "model.view_transform", dict.fromkeys(own, 1))
        self.check_depth_bins("model.view_transform")
        if len(self.z_range_m) != 2 or not self.z_range_m[0] < self.z_range_m[1]:
            raise ConfigError(
                f"model.view_transform.z_range_m={self.z_range_m}: must be [low, high] in metres with low < high"
            )


@dataclass
class LiftedViews:
    """The camera map and the depths it was made with."""

    bev: Tensor  # [B, C, rows, cols] float32, channels last
    depth_logits: Tensor  # [B, N, D, h, w], softmax over D gives the depth distribution
    num_lifted: int  # (pixel, bin) pairs that fell into a cell, of all samples


class LiftSplat(nn.Module):
    """Depth distribution times context features of every pixel, pooled into cells by one weighted segment sum.

    The frustum tensor [N, D, C, h, w] of the published formulation is never built: a cell sums its (pixel, bin) pairs,
    the pixels' context features weighted by the bins' probabilities.
    """

    def __init__(self, config: LiftSplatConfig, in_channels: int, grid: BEVGrid) -> None:
        super().__init__()
        self.config, self.grid = config, grid
        hidden = config.hidden_channels
        self.trunk = nn.Sequential(DenseConvNormReLU(in_channels, hidden, 3), BasicBlock(hidden, hidden, 1, MapConv2d))
        self.depth = MapConv2d(hidden, config.num_depth_bins, 1)
        self.context = MapConv2d(hidden, config.context_channels, 1)
        centres = lid_centres(config.depth_range, config.num_depth_bins)
        self.register_buffer("depth_centres_m", centres, persistent=False)

    def forward(
        self,
        views: CameraViews,  # one level, the image features [B, N, C_I, h, w]
    ) -> LiftedViews:
        """Pool all views of every sample; a missing view contributes nothing."""
        hidden = self.trunk(views.levels[0].flatten(0, 1))
        return self.splat(self.depth(hidden), self.context(hidden), views)

    def splat(
        self,
        depth: Tensor,  # [B*N, D, h, w] logits
        context: Tensor,  # [B*N, C, h, w]
        views: CameraViews,
        lifted: Tensor | None = None,  # [B*N, h, w] bool, the pixels whose likely bins alone are lifted
    ) -> LiftedViews:
        """Pool depth times context into cells; with `lifted` only of its pixels, and bins of no less than 1 / D."""
        (b, n), (h, w) = views.valid.shape, depth.shape[-2:]
        with torch.autocast(depth.device.type, enabled=False):  # sums of many terms, weighted by probabilities
            probabilities = rows_of_map(depth.float()).softmax(1)  # [B*N*h*w, D]
            kept = views.valid[:, :, None, None, None]
            if lifted is not None:
                likely = (probabilities >= 1 / depth.shape[1]) & lifted.flatten()[:, None]
                kept = kept & likely.view(b, n, h, w, -1)
            pairs, cells, by_pixel = self.pair(self.lift(views, (h, w)), kept)
            weights = probabilities.flatten().index_select(0, pairs)
            pixels = torch.div(pairs, self.config.num_depth_bins, rounding_mode="floor")
            shape = (b, self.grid.rows, self.grid.cols)
            values = rows_of_map(context.float())
            pooled = weighted_segment_sum(values, weights, pixels, cells, torch.Size(shape).numel(), by_pixel)
        return LiftedViews(map_of_rows(pooled, shape), depth.unflatten(0, (b, n)), len(pairs))

    @torch.no_grad()
    def lift(
        self,
        views: CameraViews,
        level_size: tuple[int, int],  # (h, w)
    ) -> Tensor:  # [B, N, h, w, D, 3] aug metres, float32
        """Points at the pixel centres and the bins' mean depths."""
        aug_from_pix = views.aug_from_pix[:, :, None, None]  # [B, N, 1, 1, 4, 4]
        pixels = pixel_centres(views.image_size_px, level_size, aug_from_pix.device).unbind(-1)  # u, v, 1: [h, w] each
        # Not a matrix product: a GPU may round its factors to fewer digits.
        rays = sum(aug_from_pix[..., :3, i] * part[..., None] for i, part in enumerate(pixels))
        return rays[..., None, :] * self.depth_centres_m[:, None] + aug_from_pix[..., None, :3, 3]

    @torch.no_grad()
    def pair(
        self,
        points: Tensor,  # [B, N, h, w, D, 3] aug metres
        kept: Tensor,  # bool, broadcasts to [B, N, h, w, D]
    ) -> tuple[Tensor, Tensor, Tensor]:  # [pairs] int64 each
        """Kept (pixel, bin) pairs that fall into a cell as pixel * D + bin, in the order of cells; the linear key of
        each pair's cell, ascending; and where in this order the pairs lie when they are taken pixel by pixel.
        """
        low, high = self.config.z_range_m
        inside = self.grid.contains(points[..., :2]) & (points[..., 2] >= low) & (points[..., 2] < high)
        inside &= kept
        hits = inside.flatten().nonzero().squeeze(1)  # synchronises a GPU
        cell = self.grid.cell_of(points.view(-1, 3).index_select(0, hits)[:, :2])
        sample = torch.div(hits, points[0].numel() // 3, rounding_mode="floor")
        keys, order = torch.sort(self.grid.keys_of(sample, cell), stable=True)
        return hits[order], keys, inverse_rows(order, len(order))

    @torch.no_grad()
    def depth_target(
        self,
        batch: FrameBatch,  # with images and annotations
        image_size_px: tuple[int, int],  # (H, W)
    ) -> Tensor:  # [B*N, h, w] int64
        """Depth bin at the pixels of annotated boxes, -1 elsewhere, as Horizon3D's camera branch (method 4.3)."""
        joined, sample = upload_boxes(*supervised_boxes(batch.boxes, self.grid), device=batch.device)
        seen = view_boxes(joined, sample, batch.pix_from_aug, batch.image_valid, image_size_px)
        bins = (self.config.depth_range, self.config.num_depth_bins)
        return paint_depth(seen, batch.image_valid.numel(), image_size_px, *bins, self.config.image_stride_px)
