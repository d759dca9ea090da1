"""Camera heads: where objects are in the images, their depth, and what both are compared with (method 4.2, 4.3)."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.errors import ConfigError, require_least
from src.geometry.bev_grid import BEVGrid
from src.losses.classification import depth_cross_entropy, penalty_reduced_focal
from src.losses.normalizers import mean_over_ranks
from src.models.layers.dense import Conv2d
from src.models.layers.full_precision import FullPrecisionConv2d
from src.models.layers.merging import with_relu
from src.models.layers.views import CameraViews
from src.ops.score_and_lift_pixels import score_and_lift_pixels
from src.ops.take_rows import take_rows
from src.targets.depth import DepthBinsConfig, paint_depth
from src.targets.keypoints import keypoint_heatmap
from src.targets.projection import BoxViews

# Probability 0.1 for every pixel at the start, so that the focal loss is not drowned by background.
KEYPOINT_BIAS = -2.19
CHANNELS_PER_NORM_GROUP = 4


@dataclass(kw_only=True)
class KeypointQueryConfig(DepthBinsConfig):
    """How queries start at objects found in the images (`model.queries`). Raises ConfigError for values that cannot
    work; every other integer of a model's own must be at least 1."""

    keypoint_nms_cells: int  # odd window of local maxima in the keypoint map

    def __post_init__(self) -> None:
        counts = [field.name for field in fields(self) if isinstance(getattr(self, field.name), int)]
        require_least(self, "model.queries", dict.fromkeys(counts, 1))
        self.check_depth_bins("model.queries")
        if self.keypoint_nms_cells % 2 == 0:
            raise ConfigError(f"model.queries.keypoint_nms_cells={self.keypoint_nms_cells}: must be odd")


@dataclass
class CameraMaps:
    """Predictions of the camera heads on the finest image level, for B samples of N views."""

    keypoint_logits: Tensor  # [B, N, h, w], sigmoid gives S
    depth_logits: Tensor  # [B, N, D, h, w], softmax over D gives the depth distribution
    features: Tensor  # [B, N, C, h, w], what both branches read


class CameraKeypointHead(nn.Module):
    """2D keypoint map and depth distribution from one shared 3x3 convolution; 0.53 M parameters at full size."""

    static_parts = ("",)

    def __init__(self, in_channels: int, channels: int, num_depth_bins: int) -> None:
        super().__init__()
        groups = max(1, channels // CHANNELS_PER_NORM_GROUP)
        self.shared = nn.Sequential(
            Conv2d(in_channels, channels, 3, padding=1, bias=False), nn.GroupNorm(groups, channels), nn.ReLU()
        )
        self.keypoint = nn.Sequential(
            Conv2d(channels, channels // 2, 3, padding=1), nn.ReLU(), FullPrecisionConv2d(channels // 2, 1, 1)
        )
        self.depth = nn.Sequential(
            Conv2d(channels, channels, 3, padding=1, bias=False),
            nn.GroupNorm(groups, channels),
            nn.ReLU(),
            FullPrecisionConv2d(channels, num_depth_bins, 1),
        )
        nn.init.constant_(self.keypoint[-1].bias, KEYPOINT_BIAS)

    def merge_for_inference(self) -> None:
        """A convolution applies the ReLU behind it."""
        self.keypoint[0], self.keypoint[1] = with_relu(self.keypoint[0]), nn.Identity()

    def forward(
        self,
        level: Tensor,  # [B, N, C_I, h, w] finest level of the image pyramid
    ) -> CameraMaps:
        """Both maps, each view independently."""
        b, n = level.shape[:2]
        features = self.shared(level.flatten(0, 1))  # [B*N, C, h, w]
        return CameraMaps(
            keypoint_logits=self.keypoint(features).unflatten(0, (b, n)).squeeze(2),
            depth_logits=self.depth(features).unflatten(0, (b, n)),
            features=features.unflatten(0, (b, n)),
        )


def lift_keypoints(
    maps: CameraMaps,
    views: CameraViews,
    depth_centres_m: Tensor,  # [D]
    grid: BEVGrid,
    count: int,  # K
    nms_cells: int | None,
) -> tuple[Tensor, Tensor, Tensor]:  # [B, K, 3] aug metres, [B, K] bool, [B, K, C]
    """The K best pixels of all views of a sample by S times confidence, lifted into the grid without gradient, whether
    there was another at all, and their features."""
    with torch.no_grad():
        inputs = (maps.keypoint_logits, maps.depth_logits, depth_centres_m, views.aug_from_pix, views.valid)
        scores, points = score_and_lift_pixels(*inputs, views.image_size_px, grid, nms_cells)
        best, picks = best_pixels(scores, count)
        points = take_rows(points.flatten(1, 3), picks)
    local = maps.features.movedim(2, -1).flatten(1, 3)  # [B, N*h*w, C]
    return points, best > 0, take_rows(local, picks)


def best_pixels(
    scores: Tensor,  # [B, N, h, w]
    count: int,  # K
) -> tuple[Tensor, Tensor]:  # [B, K] scores, [B, K] int64 places in N * h * w
    """One ranking over the pixels of all views of a sample; where there are fewer, score and place are 0."""
    best, picks = scores.flatten(1).topk(min(count, scores[0].numel()), dim=1)
    missing = count - picks.shape[1]
    return (F.pad(best, (0, missing)), F.pad(picks, (0, missing))) if missing > 0 else (best, picks)


def camera_losses(
    maps: CameraMaps,
    views: CameraViews,
    seen: BoxViews,
    depth_range_m: tuple[float, float],
    keypoint_weight: float | None,
    depth_weight: float | None,
) -> dict[str, Tensor]:
    """Weighted terms `keypoint` and `depth` (method 4.3); a weight of None leaves its term out."""
    terms = {}
    if keypoint_weight is not None:
        logits = maps.keypoint_logits.flatten(0, 1)  # [B*N, h, w]
        target = keypoint_heatmap(seen, len(logits), views.image_size_px, depth_range_m, views.finest_stride_px)
        present = views.valid.flatten()[:, None, None]  # a missing camera says nothing about what is absent
        total = (penalty_reduced_focal(logits, target) * present).sum()
        terms["keypoint"] = keypoint_weight * (total / mean_over_ranks((target == 1).sum()))
    if depth_weight is not None:
        logits = maps.depth_logits.flatten(0, 1)  # [B*N, D, h, w]
        bins = (depth_range_m, logits.shape[1])
        target = paint_depth(seen, len(logits), views.image_size_px, *bins, views.finest_stride_px)
        total = depth_cross_entropy(logits, target)
        terms["depth"] = depth_weight * total / mean_over_ranks((target >= 0).sum())
    return terms
