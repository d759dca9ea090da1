"""Settings of LRS4Fusion (`model`)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import ClassVar, Self

from src.errors import ConfigError, require_least
from src.geometry.voxel_grid import VoxelGrid
from src.models.detector import ModelConfig
from src.models.heads.center_head import BoxOptions, HeadConfig
from src.models.lrs4fusion.bev_neck import BEVNeckConfig
from src.models.lrs4fusion.decoders import DecoderConfig
from src.models.lrs4fusion.late_encoder import NUM_SCALES
from src.models.lrs4fusion.ray_head import RayHeadConfig
from src.models.lrs4fusion.ray_loss import LRSLossConfig
from src.models.lrs4fusion.windowed_fusion import VolumeMemoryConfig

SENSORS = ("lidar",)
"""What can be read today."""


class LRSStage(StrEnum):
    """What a phase trains (lrs 6.2 to 6.4): the volume and its decoders; the ray head alone; boxes, and all but the
    decoders with them."""

    occupancy = "occupancy"
    forecast = "forecast"
    detection = "detection"


@dataclass(kw_only=True)
class LRSOptions(BoxOptions):
    """What a phase says to this family (`phase.options`). Raises ConfigError for an unknown stage."""

    velocity_code_weight: float | None  # null where no boxes are learned
    stage: str  # one of LRSStage
    train_last_transition: bool  # learn also through the encoding of the frame before, where frames bring their past

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.stage not in list(LRSStage):
            raise ConfigError(f"phase.options.stage={self.stage}: must be one of {', '.join(LRSStage)}")
        if self.stage == LRSStage.detection and self.velocity_code_weight is None:
            raise ConfigError("phase.options.velocity_code_weight=null: a number is needed where boxes are learned")


@dataclass(kw_only=True)
class RoiConfig:
    """The region of interest and its finest voxels (`model.roi`), each (x, y, z); see `VoxelGrid`."""

    lower_m: list[float]
    upper_m: list[float]
    voxel_m: list[float]

    def build(self, num_levels: int) -> VoxelGrid:
        """The checked grid."""
        return VoxelGrid(tuple(self.lower_m), tuple(self.upper_m), tuple(self.voxel_m), num_levels)


@dataclass(kw_only=True)
class UNetConfig:
    """Settings of the sparse U-Net (`model.unet`), whose levels are those of the encoder."""

    point_channels: int  # of the voxel PointNet
    encoder_channels: list[list[int]]  # by level, the finest first
    decoder_channels: list[list[int]]  # (lateral, merged, upsampled) by level, the coarsest first

    def __post_init__(self) -> None:
        require_least(self, "model.unet", {"point_channels": 1})
        if len(self.encoder_channels) < NUM_SCALES:
            raise ConfigError(
                f"model.unet.encoder_channels={self.encoder_channels}: must have at least {NUM_SCALES} levels"
            )


@dataclass(kw_only=True)
class LateEncoderConfig:
    """Settings of the fusion's stem and the late encoder (`model.late_encoder`)."""

    fused_channels: int  # between the two layers of the stem
    stem_channels: int  # what the late encoder reads
    scale_channels: list[int]  # V1 .. V4
    max_sites: list[int]  # guard, per sample, after every dilating convolution of the scale

    def __post_init__(self) -> None:
        require_least(self, "model.late_encoder", {"fused_channels": 1, "stem_channels": 1})
        for name in ("scale_channels", "max_sites"):
            value = getattr(self, name)
            if len(value) != NUM_SCALES or min(value) < 1:
                raise ConfigError(f"model.late_encoder.{name}={value}: must list {NUM_SCALES} positive numbers")


@dataclass(kw_only=True)
class LRS4FusionConfig(ModelConfig):
    """Settings of the model (`model`); `channels` is the head's width. Raises ConfigError for parts that do not fit."""

    temporal_part: ClassVar[str] = "temporal"
    new_in_temporal_phase: ClassVar[str] = r"(ray_head|neck|head)\."
    keys_of_later_phases: ClassVar[tuple[str, ...]] = (
        *("model.channels", "model.ray_head", "model.head"),
        *("model.neck.stage_channels", "model.neck.stage_strides", "model.neck.layers_per_stage"),
        *("model.neck.fpn_channels", "model.loss.heatmap_weight", "model.loss.box_weight"),
        *("model.loss.range_weight", "model.loss.rays_per_frame", "model.loss.ray_range_power"),
    )  # not model.neck.finest_scale: it stands in the command of a published run, whose source would be another

    sensors: list[str]  # which of SENSORS are read
    norm_momentum: float  # weight of a new batch in the running statistics; few steps need a large one
    measured_motion: bool  # measured speeds move returns, voxels and memory, and are where velocities begin
    roi: RoiConfig
    unet: UNetConfig
    late_encoder: LateEncoderConfig
    temporal: VolumeMemoryConfig | None  # null: single frames
    decoders: DecoderConfig
    ray_head: RayHeadConfig
    neck: BEVNeckConfig
    head: HeadConfig
    loss: LRSLossConfig

    def __post_init__(self) -> None:
        require_least(self, "model", {"channels": 1})
        if not 0 < self.norm_momentum <= 1:
            raise ConfigError(f"model.norm_momentum={self.norm_momentum}: must lie in (0, 1]")
        if tuple(self.sensors) != SENSORS:
            raise ConfigError(f"model.sensors={self.sensors}: must be {list(SENSORS)}")
        if self.temporal is not None and self.temporal.velocity_compensation and not self.decoders.velocity:
            raise ConfigError(
                "model.temporal.velocity_compensation=true needs model.decoders.velocity=true, which predicts it"
            )
        self.roi.build(len(self.unet.encoder_channels))

    def at_range(self, range_m: float) -> Self:
        """As near to it as whole voxels of the coarsest level allow; as high as before."""
        step = 2 ** (len(self.unet.encoder_channels) - 1)
        half = [math.ceil(2 * range_m / (step * size)) * step * size / 2 for size in self.roi.voxel_m[:2]]
        lower, upper = ([sign * x for x in half] for sign in (-1, 1))
        roi = replace(self.roi, lower_m=[*lower, self.roi.lower_m[2]], upper_m=[*upper, self.roi.upper_m[2]])
        return replace(self, roi=roi)

    @property
    def moves_memory(self) -> bool:
        """Whether the memory compensates for velocities."""
        return self.temporal is not None and self.temporal.velocity_compensation

    @property
    def keys_of_temporal_phase(self) -> tuple[str, ...]:
        """None: the phase before remembers as well."""
        return ()
