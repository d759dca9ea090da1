"""Where object queries start: at radar points, at lifted camera keypoints, and at learnt places."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.geometry.bev_grid import BEVGrid
from src.models.heads.center_head import HEATMAP_BIAS
from src.models.heads.keypoint_head import CameraKeypointHead, CameraMaps, KeypointQueryConfig, lift_keypoints
from src.models.layers.full_precision import FullPrecisionLinear
from src.models.layers.views import CameraViews
from src.models.sparc.point_transformer import RadarPoints
from src.ops.nms import maxpool_peaks
from src.ops.segment_reduce import topk_per_sample
from src.structures.queries import UNKNOWN_LOGIT, Queries
from src.structures.taxonomy import CLASSES
from src.targets.depth import lid_centres


@dataclass(kw_only=True)
class ProposalConfig(KeypointQueryConfig):
    """Settings of the queries (`model.queries`)."""

    num_radar: int  # at the best peaks among the radar points
    num_camera: int  # at the best keypoints of the images, lifted by their depth
    num_learned: int  # at learnt places


@dataclass
class Proposals:
    """The queries of B frames and the maps they come from."""

    queries: Queries
    heatmap_logits: Tensor  # [M, 12] float32, of the radar points
    camera: CameraMaps


class QueryProposals(nn.Module):
    """Queries that start at something: StreamPETR's all start at learnt places, which takes long to learn.

    Radar points and pixels are ranked without gradient; the features of those chosen carry it.
    """

    def __init__(self, config: ProposalConfig, channels: int, image_channels: int, grid: BEVGrid) -> None:
        super().__init__()
        self.config, self.grid = config, grid
        self.heatmap = nn.Sequential(
            nn.Linear(channels, channels), nn.ReLU(), FullPrecisionLinear(channels, len(CLASSES))
        )
        nn.init.constant_(self.heatmap[-1].bias, HEATMAP_BIAS)
        self.camera_head = CameraKeypointHead(image_channels, channels, config.num_depth_bins)
        self.from_radar, self.from_camera = nn.Linear(channels, channels), nn.Linear(channels, channels)
        self.learned_features = nn.Parameter(0.02 * torch.randn(config.num_learned, channels))
        # In units of the half extent, so that one step of Adam is of the order of a metre.
        self.learned_places = nn.Parameter(torch.empty(config.num_learned, 2).uniform_(-0.7, 0.7))
        centres = lid_centres(config.depth_range, config.num_depth_bins)
        self.register_buffer("depth_centres_m", centres, persistent=False)
        extent = torch.tensor([grid.centre_m, grid.half_extent_m])
        self.register_buffer("extent_m", extent, persistent=False)

    def forward(self, radar: RadarPoints, views: CameraViews) -> Proposals:
        """Radar, camera and learnt queries, in this order."""
        logits, camera = self.heatmap(radar.bev.features), self.camera_head(views.levels[0])
        parts = [self._radar(logits.detach(), radar), self._camera(camera, views), self._learned(len(views.valid))]
        return Proposals(Queries.concatenate(parts, dim=1), logits, camera)

    def _radar(self, logits: Tensor, radar: RadarPoints) -> Queries:
        """The peaks of the heat map of any class; they bring their place, their radial velocity, and the scores of the
        classes of which they are peaks: of the others a neighbour brings a better one."""
        bev, peaks = radar.bev, maxpool_peaks(logits.sigmoid(), radar.bev.sites)
        scores = (logits.sigmoid() * peaks).amax(1)
        logits = torch.where(peaks, logits, logits.clamp(max=UNKNOWN_LOGIT))
        rows = topk_per_sample(scores, bev.indices[:, 0], bev.batch_size, self.config.num_radar)
        picks = torch.where(rows >= 0, rows, len(bev))  # one more row, which padding reads
        features, means, known = (F.pad(table, (0, 0, 0, 1)) for table in (bev.features, radar.means, logits))
        valid = (rows >= 0) & (F.embedding(picks, F.pad(scores, (0, 1))[:, None]).squeeze(-1) > 0)
        point = F.embedding(picks, means)
        return Queries(
            self.from_radar(F.embedding(picks, features)), point[..., :3], point[..., 4:6], known[picks], valid
        )

    def _camera(self, camera: CameraMaps, views: CameraViews) -> Queries:
        wanted, window = self.config.num_camera, self.config.keypoint_nms_cells
        points, valid, local = lift_keypoints(camera, views, self.depth_centres_m, self.grid, wanted, window)
        points, local = (torch.where(valid[..., None], value, 0.0) for value in (points, local))
        return Queries.unknown(self.from_camera(local), points, valid)

    def _learned(self, batch_size: int) -> Queries:
        middle, half = self.extent_m.unbind(0)
        xy = middle + half * self.learned_places
        centers = F.pad(xy, (0, 1)).expand(batch_size, -1, -1)
        features = self.learned_features.expand(batch_size, -1, -1)
        return Queries.unknown(features, centers, torch.ones(centers.shape[:2], dtype=torch.bool, device=xy.device))
