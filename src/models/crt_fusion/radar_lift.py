"""Multi-view fusion of CRT-Fusion: radar in the images before they are lifted (its Sec. 3.2)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from src.errors import ConfigError, require_least
from src.geometry.bev_grid import BEVGrid
from src.models.crt_fusion.azimuth_attention import AzimuthAttention
from src.models.layers.full_precision import FullPrecisionConv2d
from src.models.layers.lift_splat import LiftedViews, LiftSplat, LiftSplatConfig
from src.models.layers.views import CameraViews


@dataclass(kw_only=True)
class RadarLiftConfig(LiftSplatConfig):
    """Settings of the view transform (`model.view_transform`). Raises ConfigError for values that cannot work."""

    attention_channels: int  # hidden width of the azimuth attention
    pillars_per_column: int  # K, those nearest in azimuth that a column of an image attends to
    foreground_threshold: float  # pixels of lower foreground probability are not lifted

    def __post_init__(self) -> None:
        super().__post_init__()
        require_least(self, "model.view_transform", {"attention_channels": 1, "pillars_per_column": 1})
        if not 0 <= self.foreground_threshold < 1:
            raise ConfigError(
                f"model.view_transform.foreground_threshold={self.foreground_threshold}: must be at least 0 and below 1"
            )


@dataclass
class RadarLiftedViews(LiftedViews):
    """The camera map, and what decided where it comes from."""

    foreground_logits: Tensor  # [B*N, h, w] float32


class RadarLift(LiftSplat):
    """Lift-splat of image features that know the radar, of foreground pixels and their likely depths alone."""

    def __init__(self, config: RadarLiftConfig, in_channels: int, radar_channels: int, grid: BEVGrid) -> None:
        super().__init__(config, in_channels, grid)
        self.attention = AzimuthAttention(
            in_channels, radar_channels, config.attention_channels, config.pillars_per_column, grid
        )
        self.foreground = FullPrecisionConv2d(config.hidden_channels, 1, 1)

    def forward(
        self,
        views: CameraViews,  # one level, the image features [B, N, C_I, h, w]
        radar_bev: Tensor,  # [B, C_radar, rows, cols]
    ) -> RadarLiftedViews:
        """Pool all views of every sample; a missing view contributes nothing."""
        hidden = self.trunk(self.attention(views, radar_bev))
        foreground = self.foreground(hidden).squeeze(1)
        lifted = foreground.sigmoid() >= self.config.foreground_threshold
        found = self.splat(self.depth(hidden), self.context(hidden), views, lifted)
        return RadarLiftedViews(found.bev, found.depth_logits, found.num_lifted, foreground)
