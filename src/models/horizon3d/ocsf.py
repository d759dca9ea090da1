"""OCSF, object-centric sparse fusion: encode Gaussians, splat them, fuse with the radar map (Sec. 3.2)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import partial

from torch import Tensor, nn

from src.errors import ConfigError, require_least
from src.geometry.bev_grid import BEVGrid
from src.models.horizon3d.gaussian_encoder import FIXED_POINTS, EncoderLayer, GaussianBounds, GaussianEncoder
from src.models.horizon3d.sparse_fusion import SparseFusion
from src.models.horizon3d.splatting import GaussianSplat, splat_set
from src.models.layers.doppler import Doppler
from src.models.layers.views import CameraViews
from src.ops.fixed_shapes import fixed_shapes
from src.structures.gaussians import GaussianSet
from src.structures.sparse_bev import SparseBEV


class CrossAttention(Enum):
    """Order of radar and image attention: Eq. 2 adds both, Fig. 2 lets images follow radar."""

    parallel = "parallel"
    chained = "chained"


class RefineFrom(Enum):
    """Which features the refinement reads: Fig. 2 those after the self-encoding, Eq. 3 those before it."""

    self_encoding = "self_encoding"
    cross_attention = "cross_attention"


@dataclass(kw_only=True)
class OCSFConfig:
    """Settings of OCSF (`model.ocsf`). Raises ConfigError for values that cannot work."""

    num_layers: int  # L
    num_learnable_points: int  # sampling points beside the fixed ones
    margin_m: float  # epsilon, added to length and to width of the boxes that supervise occupancy
    occupancy_threshold: float  # tau
    max_occupied_cells: int  # guard, per sample
    scale_range_m: list[float]  # [smallest, largest] standard deviation
    max_mean_shift_m: float  # bound of one refinement step per axis
    max_speed_mps: float  # bound of a Gaussian's velocity per axis
    velocity_unit_mps: float  # in which the network states it
    support_sigmas: float  # a Gaussian ends at this many standard deviations
    cross_attention: CrossAttention
    refine_from: RefineFrom
    gate_kernel_size: int  # of psi: 1 or 3
    identity_start: bool  # untrained, the fusion passes the radar map through

    def __post_init__(self) -> None:
        own = {"num_layers": 1, "num_learnable_points": 0, "max_occupied_cells": 1, "margin_m": 0}
        require_least(self, "model.ocsf", own)
        for name in ("max_mean_shift_m", "max_speed_mps", "velocity_unit_mps", "support_sigmas"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"model.ocsf.{name}={getattr(self, name)}: must be positive")
        if not 0 < self.occupancy_threshold < 1:
            raise ConfigError(f"model.ocsf.occupancy_threshold={self.occupancy_threshold}: must lie between 0 and 1")
        if len(self.scale_range_m) != 2 or not 0 < self.scale_range_m[0] < self.scale_range_m[1]:
            raise ConfigError(
                f"model.ocsf.scale_range_m={self.scale_range_m}: must be [low, high] in metres with 0 < low < high"
            )
        if self.gate_kernel_size not in (1, 3):
            raise ConfigError(f"model.ocsf.gate_kernel_size={self.gate_kernel_size}: must be 1 or 3")

    @property
    def num_points(self) -> int:
        """K, sampling points of each Gaussian."""
        return len(FIXED_POINTS) + self.num_learnable_points

    @property
    def bounds(self) -> GaussianBounds:
        """Ranges of the attributes."""
        return GaussianBounds(
            tuple(self.scale_range_m), self.max_mean_shift_m, self.max_speed_mps, self.velocity_unit_mps
        )


@dataclass
class OCSFOutput:
    """What the occupancy loss, the head and later frames read."""

    gaussians: GaussianSet  # G_L
    splat: GaussianSplat
    fused_bev: SparseBEV  # F_fuse
    loss_velocities: Tensor  # [B, G, 2] velocities that losses see, see `DopplerConfig`


class OCSF(nn.Module):
    """Gaussian encoder, splatting and sparse fusion (method 5)."""

    def __init__(
        self,
        config: OCSFConfig,
        channels: int,
        image_channels: int,
        num_views: int,
        num_levels: int,
        grid: BEVGrid,
        temporal_heads: int | None,  # of the self-attention over current and history Gaussians, None without
    ) -> None:
        super().__init__()
        self.config, self.grid = config, grid
        layer = partial(
            EncoderLayer,
            channels,
            config.num_learnable_points,
            num_views,
            num_levels,
            grid,
            config.bounds,
            chained_attention=config.cross_attention is CrossAttention.chained,
            refine_before_self_encoding=config.refine_from is RefineFrom.cross_attention,
            temporal_heads=temporal_heads,
        )
        self.encoder = GaussianEncoder(channels, image_channels, grid, config.bounds, config.num_layers, layer)
        self.fusion = SparseFusion(channels, config.gate_kernel_size, config.identity_start)

    def forward(
        self,
        gaussians: GaussianSet,
        radar_bev: SparseBEV,
        views: CameraViews,
        doppler: Doppler | None = None,  # velocities take their radial part from it
    ) -> OCSFOutput:
        """G_0 to F_fuse."""
        config = self.config
        picks = gaussians.valid_rows() if fixed_shapes() is None else None  # once, since a GPU has to wait
        gaussians, loss_velocities = self.encoder(gaussians, radar_bev, views, doppler, picks)
        limits = (config.occupancy_threshold, config.max_occupied_cells, config.support_sigmas)
        splat = splat_set(gaussians, self.grid, *limits, picks)
        return OCSFOutput(gaussians, splat, self.fusion(splat.bev, radar_bev), loss_velocities)
