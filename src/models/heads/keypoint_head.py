"""Camera heads of KGGI: where objects are in the images, and their depth (method 4.2)."""

from __future__ import annotations

from dataclasses import dataclass

import torch.nn.functional as F
from torch import Tensor, nn

from src.models.layers.full_precision import FullPrecisionConv2d

# Probability 0.1 for every pixel at the start, so that the focal loss is not drowned by background.
KEYPOINT_BIAS = -2.19
CHANNELS_PER_NORM_GROUP = 4


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
            nn.Conv2d(in_channels, channels, 3, padding=1, bias=False), nn.GroupNorm(groups, channels), nn.ReLU()
        )
        self.keypoint = nn.Sequential(
            nn.Conv2d(channels, channels // 2, 3, padding=1), nn.ReLU(), FullPrecisionConv2d(channels // 2, 1, 1)
        )
        self.depth = nn.Sequential(
            nn.Conv2d(channels, channels, 3, padding=1, bias=False),
            nn.GroupNorm(groups, channels),
            nn.ReLU(),
            FullPrecisionConv2d(channels, num_depth_bins, 1),
        )
        nn.init.constant_(self.keypoint[-1].bias, KEYPOINT_BIAS)

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


def keypoint_scores(
    maps: CameraMaps,
    nms_cells: int | None,
) -> Tensor:  # [B, N, h, w] in 0..1
    """S, with everything but the maxima of an nms_cells x nms_cells window set to zero if a window is given."""
    scores = maps.keypoint_logits.float().sigmoid()
    if nms_cells is None:
        return scores
    peaks = F.max_pool2d(scores, nms_cells, stride=1, padding=nms_cells // 2)
    return scores * (scores == peaks)
