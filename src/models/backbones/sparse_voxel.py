"""Points to voxels to a sparse BEV map (VoxelNeXt, method 2), for radar and for any other point sensor."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from functools import partial
from typing import ClassVar

import torch
from torch import Tensor, nn

from src.errors import ConfigError, require_least
from src.geometry.bev_grid import BEVGrid
from src.models.backbones.local_means import LocalMeans
from src.models.layers.sparse import ConvNormReLU, PrunedSparseConv, ResidualBlock, SparseConv, SubmanifoldConv
from src.ops.segment_reduce import segment_sum
from src.ops.sites import Sites
from src.ops.voxelize import voxelize
from src.structures.sparse_bev import SparseBEV, SparseMap

# x, y, z (m), rcs (dB), vx, vy (m/s), dt (s) divided by these (method 1.3)
POINT_SCALES = (150.0, 150.0, 5.0, 20.0, 20.0, 20.0, 0.5)
BACKBONE_NORM_EPS = 1e-3
BAND_MARGIN_M = 1e-3
"""The upper end of the height band is open."""
SHARED_NORM = {"eps": 1e-5, "momentum": 0.1}  # the public code leaves torch's defaults here


class ConvOut(Enum):
    """Sites of the last convolution; members are spelled as in the configuration."""

    sparse = "sparse"  # dilates by one cell
    subm = "subm"  # keeps the sites


@dataclass(kw_only=True)
class VoxelEncoderConfig:
    """Settings of an encoder of points.

    Raises ConfigError for values that cannot work on any grid; what depends on the grid is checked by the encoder.
    """

    key: ClassVar[str] = "model.encoder"
    """Where the configuration holds it, for messages."""

    voxel_size_m: list[float]  # [x, y, z]; x = y = cell_m / a power of two; z as high as the grid gives pillars
    stage_channels: list[int]  # width of the stage at stride 1, 2, 4 ... voxels
    blocks_per_stage: int  # residual blocks
    max_voxels: int  # guard, per sample
    conv_out: ConvOut
    norm_momentum: float  # weight of a new batch in the running statistics; few steps need a large one
    point_count_channel: bool  # log of the number of points as one more input channel

    def __post_init__(self) -> None:
        size = self.voxel_size_m
        if len(size) != 3 or min(size) <= 0 or size[0] != size[1]:
            raise ConfigError(
                f"{self.key}.voxel_size_m={size}: must be three positive numbers [x, y, z] with x equal to y"
            )
        if not self.stage_channels or min(self.stage_channels) < 1:
            raise ConfigError(f"{self.key}.stage_channels={self.stage_channels}: must list at least one positive width")
        require_least(self, self.key, {"blocks_per_stage": 0, "max_voxels": 1})
        if not 0 < self.norm_momentum <= 1:
            raise ConfigError(f"{self.key}.norm_momentum={self.norm_momentum}: must lie in (0, 1]")


class VoxelEncoder(nn.Module):
    """Points to a sparse map of `channels` on the BEV grid (method 2).

    Stages of submanifold residual blocks run at strides 1, 2, 4 ... voxels; those from the BEV cell on are summed over
    height and stride into one map. A single layer of voxels (pillars) runs the same network in two dimensions.

    Raises ConfigError when voxels, stages and grid do not fit together.
    """

    def __init__(
        self,
        config: VoxelEncoderConfig,
        grid: BEVGrid,
        channels: int,
        point_scales: Sequence[float],  # of the F columns of a point, of which x, y, z (m) come first
        pruning_ratio: float = 0.0,  # of sites that do not dilate on the way down to the BEV cell
    ) -> None:
        super().__init__()
        self.voxel_size_m = tuple(config.voxel_size_m)
        self.lower_m = (grid.x_min_m, grid.y_min_m, grid.z_range_m[0])
        self.max_voxels = config.max_voxels
        self.point_count_channel = config.point_count_channel
        widths = list(config.stage_channels)
        self.bev_stage = _bev_stage(config, grid)
        layers = _height_layers(config, grid)
        self.ndim = 2 if layers == 1 else 3
        plane = (grid.rows * 2**self.bev_stage, grid.cols * 2**self.bev_stage)
        self.voxel_shape = (layers, *plane)  # z, y, x of the height band
        # One layer more than the band holds, so that 41 halve to 21, 11, 6, 3 and 2 as in the public code.
        self.input_shape = plane if self.ndim == 2 else (layers + 1, *plane)
        self.register_buffer("point_scales", torch.tensor(point_scales), persistent=False)

        norm = {"eps": BACKBONE_NORM_EPS, "momentum": config.norm_momentum}
        inputs = len(point_scales) + config.point_count_channel
        self.conv_input = ConvNormReLU(SubmanifoldConv(inputs, widths[0], 3, self.ndim, bias=False), **norm)
        self.stages = nn.ModuleList(
            _stage(
                widths[index - 1] if index else None,
                width,
                config.blocks_per_stage,
                self.ndim,
                norm,
                pruning_ratio if index <= self.bev_stage else 0.0,
            )
            for index, width in enumerate(widths)
        )
        if config.conv_out is ConvOut.sparse:
            conv_out = SparseConv(widths[-1], channels, 3, 2, bias=False)
        else:
            conv_out = SubmanifoldConv(widths[-1], channels, 3, 2, bias=False)
        self.conv_out = ConvNormReLU(conv_out, **norm)
        self.shared_conv = ConvNormReLU(SubmanifoldConv(channels, channels, 3, 2, bias=True), **SHARED_NORM)

    def forward(
        self,
        points: Tensor,  # [P, F] x, y, z (m, aug frame), then what the sensor measures
        batch: Tensor,  # [P] int64 sample of each point
        batch_size: int,
    ) -> SparseBEV:
        """The map; points outside the grid are left out, and no point at all gives a map without sites."""
        return self.encode(self.voxelise(points, batch, batch_size))

    def voxelise(
        self,
        points: Tensor,  # [P, F]
        batch: Tensor,  # [P] int64
        batch_size: int,
    ) -> SparseMap:
        """Means of the normalised points of every voxel, on (B, z, y, x), or (B, y, x) for pillars; in float32."""
        points = points.float()
        sites, features, counts = voxelize(
            points / self.point_scales,
            points[:, :3],
            batch,
            self.lower_m,
            self.voxel_size_m,
            self.voxel_shape,
            batch_size,
            self.max_voxels,
        )
        if self.point_count_channel:
            features = torch.cat([features, counts.clamp(min=1).to(features.dtype).log()[:, None]], dim=1)
        axes = None if self.ndim == 3 else (0, 2, 3)
        return SparseMap(sites.on_grid((batch_size, *self.input_shape), axes), features)

    def encode(self, voxels: SparseMap) -> SparseBEV:
        """Voxel features to the map."""
        stages = self.run_stages(voxels)
        return self.shared_conv(self.conv_out(self.compress(stages[self.bev_stage :])))

    def run_stages(self, voxels: SparseMap) -> list[SparseMap]:
        """The output of every stage at its own resolution."""
        x = self.conv_input(voxels)
        outputs = []
        for stage in self.stages:
            x = stage(x)
            outputs.append(x)
        return outputs

    def compress(
        self,
        stages: list[SparseMap],  # at the BEV resolution and every coarser one
    ) -> SparseBEV:
        """Sum over height and over strides: a coarse site lands on the lowest row and column of its block."""
        shape = (stages[0].batch_size, *stages[0].sites.shape[-2:])
        sample, row, col = Sites(shape, stages[0].sites.keys).strides
        keys = []
        for depth, stage in enumerate(stages):
            above = (0,) * (stage.sites.ndim - 2)
            keys.append(stage.sites.positions((sample, *above, row * 2**depth, col * 2**depth)))
        features = torch.cat([stage.features for stage in stages])
        features = features.to(torch.promote_types(features.dtype, torch.float32))  # many terms: not in half precision
        sites, rows = Sites.unique_keys(torch.cat(keys), shape)
        if len(sites) > 0:  # without sites the (empty) features stay as they are, in the graph of their parameters
            features = segment_sum(features, rows, len(sites), sites.groups)
        return SparseBEV(sites, features)


@dataclass(kw_only=True)
class RadarEncoderConfig(VoxelEncoderConfig):
    """Settings of the radar encoder (`model.radar_encoder`)."""

    key: ClassVar[str] = "model.radar_encoder"

    local_means: bool  # mean of the points around a cell, added to F_R
    height_tolerance_deg: float  # points outside the height band by no more than this error of elevation are moved in
    pruning_ratio: float  # of voxels, the faintest, that do not dilate on the way down to the BEV cell; 0: all dilate

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.height_tolerance_deg < 90:
            raise ConfigError(f"{self.key}.height_tolerance_deg={self.height_tolerance_deg}: must lie in [0, 90)")
        if not 0 <= self.pruning_ratio <= 1:
            raise ConfigError(f"{self.key}.pruning_ratio={self.pruning_ratio}: must lie in [0, 1]")


class RadarEncoder(VoxelEncoder):
    """Radar points to F_R."""

    def __init__(self, config: RadarEncoderConfig, grid: BEVGrid, channels: int) -> None:
        super().__init__(config, grid, channels, POINT_SCALES, config.pruning_ratio)
        self.z_range_m, self.height_tolerance = grid.z_range_m, math.tan(math.radians(config.height_tolerance_deg))
        self.local_means = LocalMeans(self.point_scales, grid, channels) if config.local_means else None

    def forward(
        self,
        points: Tensor,  # [P, 7] x, y, z (m, aug frame), rcs (dB), vx, vy (m/s), dt (s)
        batch: Tensor,  # [P] int64 sample of each point
        batch_size: int,
    ) -> SparseBEV:
        """F_R, with the local means of the points where they are wanted."""
        bev = super().forward(self._into_band(points) if self.height_tolerance else points, batch, batch_size)
        return bev if self.local_means is None else self.local_means(bev, points, batch)

    def _into_band(self, points: Tensor) -> Tensor:  # [P, 7] -> [P, 7]
        """A radar's elevation is coarse: at 150 m two degrees are 5 m, and what stands on the road floats or sinks."""
        low, high = self.z_range_m
        z = points[:, 2]
        inside = z.clamp(low, high - BAND_MARGIN_M)
        near = (z - inside).abs() <= self.height_tolerance * points[:, :2].norm(dim=1)
        return torch.cat([points[:, :2], torch.where(near, inside, z)[:, None], points[:, 3:]], dim=1)


def _stage(
    in_channels: int | None, channels: int, blocks: int, ndim: int, norm: dict[str, float], pruning_ratio: float
) -> nn.Sequential:
    """Residual blocks, after a convolution of stride 2 unless the stage is the first (`in_channels` None)."""
    layers: list[nn.Module] = []
    if in_channels is not None:
        kind = partial(PrunedSparseConv, pruning_ratio=pruning_ratio) if pruning_ratio else SparseConv
        conv = kind(in_channels, channels, 3, ndim, bias=False, stride=2)
        layers.append(ConvNormReLU(conv, **norm))
    layers += [ResidualBlock(channels, ndim, **norm) for _ in range(blocks)]
    return nn.Sequential(*layers)


def _bev_stage(config: VoxelEncoderConfig, grid: BEVGrid) -> int:
    """Index of the stage whose sites are BEV cells; checks the relations between voxels, stages and grid."""
    ratio = grid.cell_m / config.voxel_size_m[0]
    stage = round(math.log2(ratio))
    if stage < 0 or not math.isclose(ratio, 2**stage, rel_tol=1e-6):
        raise ConfigError(
            f"{config.key}.voxel_size_m={config.voxel_size_m}: x and y must be grid.cell_m={grid.cell_m} "
            f"divided by a power of two, but the quotient is {ratio:g}"
        )
    widths = config.stage_channels
    if len(widths) <= stage:
        raise ConfigError(
            f"{config.key}.stage_channels={widths}: must list at least {stage + 1} stages, since a cell of "
            f"{grid.cell_m} m is 2^{stage} voxels of {config.voxel_size_m[0]} m"
        )
    if len(set(widths[stage:])) > 1:
        raise ConfigError(
            f"{config.key}.stage_channels={widths}: must be equal from stage {stage + 1} on, where stages are "
            f"summed, but got {widths[stage:]}"
        )
    coarsest = 2 ** (len(widths) - 1 - stage)
    if any(cells % coarsest for cells in grid.cells):
        raise ConfigError(
            f"grid.cells={list(grid.cells)}: each must be a multiple of {coarsest}, "
            f"the coarsest stride of {config.key} in cells"
        )
    return stage


def _height_layers(config: VoxelEncoderConfig, grid: BEVGrid) -> int:
    """Number of voxel layers in the grid's height band; 1 means pillars."""
    height = grid.z_range_m[1] - grid.z_range_m[0]
    layers = round(height / config.voxel_size_m[2])
    if layers < 1 or not math.isclose(layers * config.voxel_size_m[2], height, rel_tol=1e-6):
        raise ConfigError(
            f"{config.key}.voxel_size_m={config.voxel_size_m}: z must divide the height {height:g} m of "
            f"grid.z_range_m={list(grid.z_range_m)} into whole layers"
        )
    return layers
