"""Far3D's adaptive queries: objects found in the images, lifted to where their depth puts them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import nn

from src.errors import ConfigError
from src.geometry.bev_grid import BEVGrid
from src.models.heads.keypoint_head import CameraKeypointHead, CameraMaps, KeypointQueryConfig, best_pixels
from src.models.layers.views import CameraViews
from src.ops.score_and_lift_pixels import most_likely_depth, peak_scores
from src.ops.take_rows import take_rows
from src.structures.queries import Queries
from src.targets.depth import lid_centres


@dataclass(kw_only=True)
class AdaptiveQueryConfig(KeypointQueryConfig):
    """Settings of the adaptive queries (`model.queries`)."""

    num_proposals: int  # at most, of a frame
    score_threshold: float  # of a pixel that a query starts at

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.score_threshold < 1:
            raise ConfigError(f"model.queries.score_threshold={self.score_threshold}: must be between 0 and 1")


class AdaptiveQueries(nn.Module):
    """The best pixels of all views above a score, each at its most likely depth.

    A query's features are told of what the image shows there and of how far its score is above the threshold, in log
    odds; neither place nor features carry gradient back (public code), the camera losses teach both.
    """

    def __init__(self, config: AdaptiveQueryConfig, channels: int, image_channels: int, grid: BEVGrid) -> None:
        super().__init__()
        self.config, self.grid = config, grid
        self.head = CameraKeypointHead(image_channels, channels, config.num_depth_bins)
        self.context = nn.Sequential(nn.Linear(channels + 1, channels), nn.ReLU(), nn.Linear(channels, channels))
        centres = lid_centres(config.depth_range, config.num_depth_bins)
        self.register_buffer("depth_centres_m", centres, persistent=False)

    def forward(self, views: CameraViews) -> tuple[Queries, CameraMaps]:
        """The queries [B, num_proposals] and the maps that they come from."""
        maps, threshold = self.head(views.levels[0]), self.config.score_threshold
        with torch.no_grad():
            depth, _ = most_likely_depth(maps.depth_logits, self.depth_centres_m)
            places = views.lift(depth)  # [B, N, h, w, 3]
            inside = self.grid.contains(places[..., :2]) & views.valid[:, :, None, None]
            scores = peak_scores(maps.keypoint_logits, self.config.keypoint_nms_cells) * inside
            best, picks = best_pixels(scores, self.config.num_proposals)
            valid = best > threshold
            centers, seen = (
                torch.where(valid[..., None], take_rows(table.flatten(1, 3), picks), 0.0)
                for table in (places, maps.features.movedim(2, -1))
            )
            odds = torch.where(valid, best.logit(1e-6) - math.log(threshold / (1 - threshold)), 0.0)
        features = self.context(torch.cat([seen, odds[..., None].to(seen.dtype)], dim=-1))
        return Queries.unknown(features, centers, valid), maps
