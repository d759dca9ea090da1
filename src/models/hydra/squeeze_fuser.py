"""HyDRa's fusion of the camera's and the radar's map (method 13.7)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.models.layers.dense import map_of_rows
from src.models.layers.norm import MapBatchNorm

SQUEEZE_RATIO = 4


class SqueezeFuser(nn.Module):
    """Camera and radar map side by side, squeeze and excitation (HyDRa; Hu et al. 2018), then a 1x1 convolution.

    Each channel is weighted by what the means of all over the map say; so are the convolution's weights, which comes to
    the same. No gradient goes back through the means, in which a cell hardly counts.
    """

    norm_pairs = (("conv", "norm"),)

    def __init__(self, in_channels: int, channels: int) -> None:
        super().__init__()
        squeezed = in_channels // SQUEEZE_RATIO
        self.excitation = nn.Sequential(nn.Linear(in_channels, squeezed), nn.ReLU(), nn.Linear(squeezed, in_channels))
        self.conv = nn.Linear(in_channels, channels, bias=False)
        self.norm = MapBatchNorm(channels)

    def forward(
        self,
        camera: Tensor,  # [B, C_camera, rows, cols]
        radar: Tensor,  # [B, C_radar, rows, cols]
    ) -> Tensor:  # [B, C, rows, cols]
        means = torch.cat([x.detach().mean((2, 3)) for x in (camera, radar)], dim=1)
        weight = (self.excitation(means).sigmoid()[:, None] * self.conv.weight).transpose(1, 2)  # [B, both, C]
        own, others = weight.split([camera.shape[1], radar.shape[1]], dim=1)
        rows = [part.permute(0, 2, 3, 1).flatten(1, 2) for part in (camera, radar)]  # [B, rows * cols, channels] each
        x = torch.baddbmm(rows[0] @ own, rows[1], others)
        if self.conv.bias is not None:  # of the norm, prepared for inference
            x = x + self.conv.bias
        x = map_of_rows(x.flatten(0, 1), (len(camera), *camera.shape[2:]))
        return F.relu(self.norm(x), inplace=True)
