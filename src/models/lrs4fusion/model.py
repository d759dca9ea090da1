"""LRS4Fusion: a sparse multi-scale volume learnt from LiDAR, and what is read from it (lrs 1)."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, Self

import torch
from torch import Tensor

from src.errors import ConfigError
from src.geometry.bev_grid import BEVGrid
from src.geometry.bounds import Bounds, farthest_m
from src.models.backbones.image import ImageEncoderConfig
from src.models.detector import Detector, Objective
from src.models.heads.center_head import CenterHead, HeadOutput
from src.models.lrs4fusion.bev_neck import BEVNeck
from src.models.lrs4fusion.decoders import Decoders
from src.models.lrs4fusion.late_encoder import FUSED_SCALE, FusionStem, LateEncoder, Volumes
from src.models.lrs4fusion.lrs_config import LRS4FusionConfig, LRSOptions, LRSStage
from src.models.lrs4fusion.measured_motion import (
    MeasuredMotion,
    at_key_time,
    directions,
    ego_heading,
    return_velocities,
)
from src.models.lrs4fusion.ray_head import RayHead
from src.models.lrs4fusion.ray_loss import occupancy_objective, range_objective
from src.models.lrs4fusion.sparse_unet import SparseUNet
from src.models.lrs4fusion.volume_memory import VolumeMemory
from src.models.lrs4fusion.voxel_pointnet import VoxelPointNet
from src.models.lrs4fusion.windowed_fusion import WindowedFusion
from src.models.world_model import WorldModel
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from src.structures.ray_bundle import RayBundle

NORM_EPS = 1e-3  # PartA2's
QUERIES_AT_ONCE = 1 << 16
"""Of samples along rays: their features are 544 numbers each."""
RAYS_AT_ONCE = 1 << 12
"""Forecast without gradient: each has 2,000 samples, and a validation asks for a quarter of a million rays."""

logger = logging.getLogger(__name__)


@dataclass
class LRSOutput:
    """B frames through the model."""

    volumes: Volumes
    head: HeadOutput | None  # None where no boxes are learned


class LRS4Fusion(Detector, WorldModel):
    """LiDAR to voxels to a U-Net to a completed volume of four scales, which remembers its past (lrs 5).

    It answers queries (x, y, z, t) by occupancy and radial velocity, and gives the ranges of future rays, and boxes.
    Parts that the phase's stage does not train are frozen; those that it does not use are absent.
    Region and voxels are the model's own (`model.roi`); it has no use for the `grid` that others share.
    Raises ConfigError when parts and region do not fit, or when the stage would learn nothing.
    """

    phase_options = LRSOptions
    memory_type = VolumeMemory
    latency_parts = {
        "lidar_encoder": ("pointnet.forward", "unet.forward"),
        "late_encoder": ("stem.forward", "late_encoder.forward"),
        "temporal_fusion": ("temporal.recall", "temporal.forward", "temporal.remember"),
        "detection_head": ("neck.forward", "head.forward", "head.decode"),
    }

    def __init__(
        self, config: LRS4FusionConfig, grid: BEVGrid, backbone: ImageEncoderConfig | None, options: LRSOptions
    ) -> None:
        super().__init__()
        self.config = config
        self.stage = LRSStage(options.stage)
        self.trains_last_transition = options.train_last_transition and config.temporal is not None
        self.voxels = config.roi.build(len(config.unet.encoder_channels))
        norm = {"eps": NORM_EPS, "momentum": config.norm_momentum}
        unet, late = config.unet, config.late_encoder
        self.pointnet = VoxelPointNet(unet.point_channels, self.voxels, **norm)
        self.unet = SparseUNet(unet.point_channels, unet.encoder_channels, unet.decoder_channels, **norm)
        self.stem = FusionStem(self.unet.out_channels, late.fused_channels, late.stem_channels, norm)
        self.late_encoder = LateEncoder(late.stem_channels, late.scale_channels, late.max_sites, norm)
        self.temporal = None
        if config.temporal is not None:
            widths = (late.scale_channels[FUSED_SCALE - 1], late.scale_channels[FUSED_SCALE])
            self.temporal = WindowedFusion(config.temporal, *widths, self.voxels.at(FUSED_SCALE))
        self.decoders = Decoders(config.decoders, late.scale_channels, self.voxels)
        self.ray_head = self.neck = self.head = None
        if self.stage is LRSStage.forecast:
            self.requires_grad_(False)
            self.ray_head = RayHead(config.ray_head, farthest_m(self.bounds))
        if self.stage is LRSStage.detection:
            if (config.loss.heatmap_weight, config.loss.box_weight) == (None, None):
                raise ConfigError(
                    "model.loss.heatmap_weight and box_weight are both null, so the stage detection would learn "
                    "nothing; give one"
                )
            self.decoders.requires_grad_(False)  # they still say how fast what is remembered moves
            self.neck = BEVNeck(config.neck, late.scale_channels).to(memory_format=torch.channels_last)
            self.head = CenterHead(
                config.head,
                config.channels,
                self.voxels.at(self.neck.level).bev(),
                options.velocity_code_weight,
                dense=True,
                in_channels=self.neck.out_channels + 2 * config.measured_motion,
                class_ranges=False,  # `phase.long_range` counts all classes up to 250 m
            ).to(memory_format=torch.channels_last)

    def train(self, mode: bool = True) -> Self:
        """As the base; while only the ray head learns, all norms before it keep their running statistics."""
        super().train(mode)
        if self.stage is LRSStage.forecast:
            for name, part in self.named_children():
                part.train(mode and name == "ray_head")
        return self

    def forward(self, batch: FrameBatch, memory: VolumeMemory | None = None) -> tuple[LRSOutput, VolumeMemory | None]:
        """The volumes of B frames, given what is remembered of their streams; the new memory is detached.

        Raises ValueError for a batch without LiDAR, and for a memory of other streams, voxels or widths.
        """
        output = self.output_alone(batch, memory)
        remembered = self.remember(output.volumes, batch)
        return output, remembered if remembered is None else remembered.detached()

    def output_alone(self, batch: FrameBatch, memory: VolumeMemory | None) -> LRSOutput:
        """As in `Detector`."""
        volumes = self.encode(batch, memory)
        return LRSOutput(volumes, None if self.head is None else self._head_output(volumes))

    def encode(self, batch: FrameBatch, memory: VolumeMemory | None = None) -> Volumes:
        """The volumes alone; raises as `forward`."""
        if batch.lidar_points is None or batch.lidar_batch is None:
            raise ValueError("FrameBatch.lidar_points is None, but this model uses LiDAR; read it with the frames")
        measured = None
        if self.config.measured_motion and batch.lidar_speeds is None:
            warn_without_speeds()
        elif self.config.measured_motion:
            measured = return_velocities(batch)
            batch = replace(batch, lidar_points=at_key_time(batch.lidar_points, measured))
        voxels = self.pointnet(batch.lidar_points, batch.lidar_batch, len(batch), batch.lidar_speeds)
        x = self.stem(self.unet(voxels))
        if self.temporal is None:
            volumes, ego_mps = self.late_encoder(x), torch.full_like(batch.aug_from_ego[:, :3, 3], torch.nan)
        else:
            warped = self.temporal.recall(memory, batch)
            volumes = self.late_encoder(x, lambda current: self.temporal(current, warped))
            ego_mps = warped.ego_mps
        if measured is None:
            return volumes
        volume, grid = volumes.scales[FUSED_SCALE], self.voxels.at(FUSED_SCALE)
        return replace(volumes, measured=MeasuredMotion.of(volume, grid, batch, measured, ego_mps))

    def _head_output(self, volumes: Volumes) -> HeadOutput:
        """Where motion is measured the head sees it, and what it says of velocities is added to it."""
        x = self.neck(volumes.scales)
        if not self.config.measured_motion:
            return self.head(x)
        motion = x.new_zeros(len(x), 2, *x.shape[2:], dtype=torch.float32)
        if volumes.measured is not None:
            motion = volumes.measured.on_ground(self.head.grid)
        seen = (motion / self.config.decoders.velocity_unit_mps).to(x.dtype, memory_format=torch.channels_last)
        return self.head(torch.cat([x, seen], dim=1), base_velocities=motion)

    def remember(self, volumes: Volumes, batch: FrameBatch) -> VolumeMemory | None:
        """What the next frame needs of this one, None without temporal part.

        The remembered features carry their gradient, for the one transition that is trained through.
        """
        if self.temporal is None:
            return None
        volume, velocities = volumes.scales[FUSED_SCALE], None
        known = batch.lidar_speeds is not None
        if self.config.temporal.velocity_compensation and (known or not self.decoders.at_rest):
            indices = volume.indices
            centres = self.temporal.grid.centre_of(indices[:, 1:])
            now = torch.cat([centres, torch.zeros_like(centres[:, :1])], dim=1)
            speeds = torch.cat(_in_parts(partial(self.decoders.velocities, volumes), now, indices[:, 0]))
            if volumes.measured is None:
                velocities = speeds[:, None] * directions(centres, None)
            else:
                rays = centres - volumes.measured.origins[indices[:, 0]]
                velocities = speeds[:, None] * directions(rays, ego_heading(batch)[indices[:, 0]])
                velocities = velocities.index_copy(0, volumes.measured.rows, volumes.measured.velocities)
        return self.temporal.remember(volume, velocities, batch)

    def transition(self, batch: FrameBatch, memory: VolumeMemory | None) -> VolumeMemory | None:
        """As in `Detector`."""
        return None if self.temporal is None else self.remember(self.encode(batch, memory), batch)

    @torch.no_grad()
    def ray_occupancy(self, volumes: Volumes, rays: RayBundle) -> Tensor:  # [R, N]
        """Probability of occupancy at the ray head's samples along every ray."""
        samples = self.ray_head.samples_m
        points = rays.origins[:, None] + samples[:, None] * rays.directions[:, None]  # [R, N, 3]
        queries = torch.cat([points, rays.times_s[:, None, None].expand(-1, len(samples), 1)], dim=2).flatten(0, 1)
        ask = partial(self.decoders.occupancy_logits, volumes)
        logits = torch.cat(_in_parts(ask, queries, rays.batch.repeat_interleave(len(samples))))
        return logits.view(len(rays), len(samples)).sigmoid()

    @property
    def bounds(self) -> Bounds:
        """The region."""
        return tuple(zip(self.voxels.lower_m, self.voxels.upper_m, strict=True))

    @property
    def forecasts(self) -> bool:
        """Of the stage `forecast` alone."""
        return self.ray_head is not None

    def look_up(self, output: LRSOutput, queries: Tensor, batch: Tensor) -> tuple[Tensor, Tensor | None]:
        """As in `WorldModel`."""
        logits, speeds = zip(*_in_parts(partial(self.decoders, output.volumes), queries, batch), strict=True)
        return torch.cat(logits).sigmoid(), None if speeds[0] is None else torch.cat(speeds)

    def forecast(self, output: LRSOutput, rays: RayBundle) -> Tensor:  # [R] m
        """As in `WorldModel`; gradients go to the ray head alone."""
        if self.ray_head is None:
            raise ConfigError(f"phase.options.stage={self.stage}: ranges of rays need the stage {LRSStage.forecast}")
        at_once = max(1, len(rays)) if torch.is_grad_enabled() else RAYS_AT_ONCE
        pieces = torch.arange(len(rays), device=rays.ranges.device).split(at_once)
        return torch.cat([self.ray_head(self.ray_occupancy(output.volumes, rays[piece])) for piece in pieces])

    def loss_terms(self, output: LRSOutput, batch: FrameBatch) -> Objective:
        """Weighted terms of the stage: `heatmap` and `box`; `occupancy` and `velocity`; or `range`.

        Raises ValueError for a batch without the boxes or the rays that the stage learns from.
        """
        weights = self.config.loss
        if self.stage is LRSStage.detection:
            return self.head.loss(output.head, batch.boxes, weights.heatmap_weight, weights.box_weight)
        if batch.rays is None:
            raise ValueError(
                f"FrameBatch.rays is None, but phase.options.stage={self.stage} learns from them; give "
                "data.num_future_frames=2"
            )
        if self.stage is LRSStage.occupancy:
            return occupancy_objective(partial(self.decoders, output.volumes), batch.rays, self.bounds, weights)
        return range_objective(partial(self.forecast, output), batch.rays, self.bounds, weights)

    def decode(self, output: LRSOutput) -> list[Boxes3D]:
        """Boxes of each frame, best first. Raises ConfigError for a model that learns none."""
        if output.head is None:
            raise ConfigError(f"phase.options.stage={self.stage}: boxes need the stage {LRSStage.detection}")
        return self.head.decode(output.head)

    def diagnostics(self, output: LRSOutput) -> dict[str, Tensor | float]:
        """Sites of every scale per frame, and those that the guard has left out."""
        frames = output.volumes.scales[0].batch_size
        values: dict[str, Tensor | float] = {}
        for scale, (volume, dropped) in enumerate(zip(output.volumes.scales, output.volumes.dropped, strict=True)):
            values[f"sites_{scale + 1}"] = len(volume) / frames
            values[f"dropped_sites_{scale + 1}"] = dropped / frames
        return values


@cache
def warn_without_speeds() -> None:
    """Once a process: what `measured_motion` asks for cannot be had."""
    logger.warning(
        "model.measured_motion=true, but no return has a measured speed (data.timeline.radial_speeds=none), so nothing "
        "is moved by it"
    )


@torch.no_grad()
def _in_parts(ask: Callable[[Tensor, Tensor], Any], queries: Tensor, batch: Tensor) -> list[Any]:
    """The answers to many queries [Q, 4] and their samples [Q], a part of them at a time, without gradient."""
    parts = zip(queries.split(QUERIES_AT_ONCE), batch.split(QUERIES_AT_ONCE), strict=True)
    return [ask(*part) for part in parts]
