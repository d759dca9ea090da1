"""CenterPoint on LiDAR: VoxelNeXt's sparse backbone on points of accumulated sweeps, the sparse CenterPoint head."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from src.errors import require_least
from src.geometry.bev_grid import BEVGrid
from src.losses.loss_weights import LossWeights
from src.models.backbones.image import ImageEncoderConfig
from src.models.backbones.sparse_voxel import VoxelEncoder, VoxelEncoderConfig
from src.models.detector import Detector, ModelConfig, Objective
from src.models.heads.center_head import BoxOptions, CenterHead, HeadConfig, HeadOutput
from src.structures.batch import FrameBatch
from src.structures.sparse_bev import SparseBEV

POINT_SCALES = (150.0, 150.0, 5.0, 100.0, 0.5)
"""x, y, z (m), intensity and dt (s) are divided by these."""


@dataclass(kw_only=True)
class LidarEncoderConfig(VoxelEncoderConfig):
    """Settings of the LiDAR encoder (`model.lidar_encoder`)."""

    key: ClassVar[str] = "model.lidar_encoder"


@dataclass(kw_only=True)
class CenterPointLossConfig(LossWeights):
    """Weights of the terms (`model.loss`); null switches a term off, uncomputed."""

    heatmap_weight: float | None
    box_weight: float | None


@dataclass(kw_only=True)
class CenterPointConfig(ModelConfig):
    """Settings of the model (`model`)."""

    sensors: ClassVar[tuple[str, ...]] = ("lidar",)

    lidar_encoder: LidarEncoderConfig
    head: HeadConfig
    loss: CenterPointLossConfig

    def __post_init__(self) -> None:
        require_least(self, "model", {"channels": 1})


@dataclass
class CenterPointOutput:
    """One frame through the model."""

    lidar_bev: SparseBEV
    head: HeadOutput


class CenterPoint(Detector):
    """LiDAR points to sparse voxels to a sparse BEV map to boxes (Table 1, CenterPoint-V).

    Raises ConfigError when voxels, stages and grid do not fit together.
    """

    phase_options = BoxOptions
    latency_parts = {
        "lidar_encoder": ("lidar_encoder.forward",),
        "detection_head": ("head.forward", "head.decode"),
    }

    def __init__(
        self, config: CenterPointConfig, grid: BEVGrid, backbone: ImageEncoderConfig | None, options: BoxOptions
    ) -> None:
        super().__init__()
        self.config, self.grid = config, grid
        self.lidar_encoder = VoxelEncoder(config.lidar_encoder, grid, config.channels, POINT_SCALES)
        self.head = CenterHead(config.head, config.channels, grid, options.velocity_code_weight)

    def forward(self, batch: FrameBatch, memory: None = None) -> tuple[CenterPointOutput, None]:
        """Detect in B frames. Raises ValueError for a batch without LiDAR."""
        if batch.lidar_points is None or batch.lidar_batch is None:
            raise ValueError("FrameBatch.lidar_points is None, but this model uses LiDAR; read it with the frames")
        bev = self.lidar_encoder(batch.lidar_points, batch.lidar_batch, len(batch))
        return CenterPointOutput(bev, self.head(bev)), None

    def loss_terms(self, output: CenterPointOutput, batch: FrameBatch) -> Objective:
        """Weighted terms `heatmap` and `box`."""
        weights = self.config.loss
        return self.head.loss(output.head, batch.boxes, weights.heatmap_weight, weights.box_weight)

    def diagnostics(self, output: CenterPointOutput) -> dict[str, Tensor | float]:
        """Cells of the LiDAR map per frame."""
        return {"lidar_cells": len(output.lidar_bev) / output.lidar_bev.batch_size}
