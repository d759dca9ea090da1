"""Height association of HyDRa: image columns and the radar of their rays attend to each other before depth is known."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.errors import ConfigError, require_least
from src.geometry.bev_grid import BEVGrid
from src.models.layers.dense import rows_of_map
from src.models.layers.feed_forward import feed_forward
from src.models.layers.global_attention import GlobalAttention
from src.models.layers.lift_splat import LiftedViews, LiftSplat, LiftSplatConfig
from src.models.layers.views import CameraViews
from src.ops.segment_reduce import segment_count, segment_mean
from src.targets.depth import lid_index

FFN_RATIO = 2


@dataclass(kw_only=True)
class HeightLiftConfig(LiftSplatConfig):
    """Settings of the view transform (`model.view_transform`). Raises ConfigError for values that cannot work."""

    attention_channels: int  # width of pixels and returns in the height association
    attention_heads: int

    def __post_init__(self) -> None:
        super().__post_init__()
        require_least(self, "model.view_transform", {"attention_channels": 1, "attention_heads": 1})
        if self.attention_channels % self.attention_heads:
            raise ConfigError(
                f"model.view_transform.attention_channels={self.attention_channels}: must be a multiple of "
                f"attention_heads={self.attention_heads}"
            )


@dataclass
class HeightLiftedViews(LiftedViews):
    """The camera map, and what was lifted."""

    context: Tensor  # [B, N, C, h, w]


class HeightAssociation(nn.Module):
    """Height association transformer (HAT): two cross-attentions within every image column and its ray on the ground.

    A radar measures range and azimuth but hardly height, a pixel height and azimuth but no range; a column of an image
    and the pillars in its direction share the azimuth. Each return, one a depth bin, first asks the column's pixels how
    high it is; then each pixel asks the returns, which know it, how far it is. Columns without a return ask nothing.
    """

    def __init__(self, config: HeightLiftConfig, channels: int, radar_channels: int, rows: int, grid: BEVGrid) -> None:
        super().__init__()
        self.grid, self.depth_range, self.num_bins = grid, config.depth_range, config.num_depth_bins
        width, heads = config.attention_channels, config.attention_heads
        self.pixels, self.returns = nn.Linear(channels, width), nn.Linear(radar_channels, width)
        self.row_embedding = nn.Parameter(torch.randn(rows, width))
        self.bin_embedding = nn.Parameter(torch.randn(self.num_bins, width))
        self.to_returns, self.to_pixels = GlobalAttention(width, heads), GlobalAttention(width, heads)
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(3))
        self.mlp = feed_forward(width, FFN_RATIO)
        self.output = nn.Linear(width, channels)

    def forward(
        self,
        views: CameraViews,  # one level [B, N, C, h, w]
        radar_bev: Tensor,  # [B, C_radar, rows, cols], zero where no point fell
    ) -> Tensor:  # [B*N, C, h, w]
        """The image features with radar; a missing camera takes none."""
        columns = views.levels[0].permute(0, 1, 4, 3, 2)  # [B, N, w, h, C]
        x = self.pixels(columns).flatten(0, 2)  # [B*N*w, h, width]
        places = x + self.row_embedding
        returns, seen = self.frustum(views, radar_bev)
        every = torch.ones(x.shape[:2], dtype=torch.bool, device=x.device)
        found = self.norms[0](returns + self.to_returns(returns + self.bin_embedding, places, x, every))
        x = self.norms[1](x + self.to_pixels(places, found + self.bin_embedding, found, seen))
        x = self.norms[2](x + self.mlp(x))
        changed = columns + self.output(x).view_as(columns)
        return changed.permute(0, 1, 4, 3, 2).flatten(0, 1)

    def frustum(
        self, views: CameraViews, radar_bev: Tensor
    ) -> tuple[Tensor, Tensor]:  # [B*N*w, D, width], [B*N*w, D] bool
        """The radar as every column sees it: the mean of the pillars in each depth bin, and where there are any."""
        cells = radar_bev.any(1).nonzero()  # [P, 3] (sample, row, col) of the pillars
        keys = self.grid.keys_of(cells[:, 0], cells[:, 1:])
        pillars = self.returns(F.embedding(keys, rows_of_map(radar_bev)))
        picks, bins = self.seen_at(views, cells)
        shape = (views.valid.numel() * views.levels[0].shape[-1], self.num_bins)
        total = torch.Size(shape).numel()
        returns = segment_mean(F.embedding(picks, pillars).float(), bins, total)
        return returns.view(*shape, -1), segment_count(bins, total).view(shape) > 0

    @torch.no_grad()
    def seen_at(
        self,
        views: CameraViews,
        cells: Tensor,  # [P, 3] int64 (sample, row, col)
    ) -> tuple[Tensor, Tensor]:  # [n], [n] int64
        """Pillars and the bins they fall into, ((b * N + view) * w + column) * D + bin, of all views that see them.

        A pillar lies on a vertical; the camera sees it where that crosses the plane of the image's middle row, however
        high that is: whether the row is above the road or below does not say whether a column looks at it.
        """
        (rows, cols), width = views.image_size_px, views.levels[0].shape[-1]
        matrix = views.pix_from_aug.float()[cells[:, 0], :, :3]  # [P, N, 3, 4]
        xy = self.grid.centre_of(cells[:, 1:])[:, None, None]  # [P, 1, 1, 2]
        ground = matrix[..., 0] * xy[..., 0] + matrix[..., 1] * xy[..., 1] + matrix[..., 3]  # (u d, v d, d) at z = 0
        up, middle = matrix[..., 2], rows / 2
        height = (middle * ground[..., 2] - ground[..., 1]) / (up[..., 1] - middle * up[..., 2])  # v = middle there
        depth = ground[..., 2] + height * up[..., 2]
        u = (ground[..., 0] + height * up[..., 0]) / depth
        bins = lid_index(depth, self.depth_range, self.num_bins)  # -1 behind, too far, and of a missing camera's NaN
        inside = (bins >= 0) & (u >= 0) & (u < cols) & views.valid[cells[:, 0]]
        pillar, view = inside.nonzero().unbind(1)
        column = (u[pillar, view] * (width / cols)).long().clamp(max=width - 1)
        ray = (cells[pillar, 0] * matrix.shape[1] + view) * width + column
        return pillar, ray * self.num_bins + bins[pillar, view]


class HeightLift(LiftSplat):
    """Lift-splat of image features that know the radar."""

    def __init__(
        self, config: HeightLiftConfig, in_channels: int, radar_channels: int, image_rows: int, grid: BEVGrid
    ) -> None:
        super().__init__(config, in_channels, grid)
        rows = image_rows // config.image_stride_px
        self.association = HeightAssociation(config, in_channels, radar_channels, rows, grid)

    def forward(
        self,
        views: CameraViews,  # one level, the image features [B, N, C_I, h, w]
        radar_bev: Tensor,  # [B, C_radar, rows, cols]
    ) -> HeightLiftedViews:
        """Pool all views of every sample; a missing view contributes nothing."""
        hidden = self.trunk(self.association(views, radar_bev))
        context = self.context(hidden)
        lifted = self.splat(self.depth(hidden), context, views)
        return HeightLiftedViews(**vars(lifted), context=context.unflatten(0, views.valid.shape))
