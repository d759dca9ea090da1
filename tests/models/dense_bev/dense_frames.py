"""A dense model of a few thousand parameters."""

import torch

from src.models.backbones.bev_decoder import BEVDecoderConfig
from src.models.backbones.image import NeckName
from src.models.backbones.pillars import PillarConfig
from src.models.camera_radar import CameraRadarLossConfig
from src.models.dense_bev.model import DenseBEV, DenseBEVConfig
from src.models.heads.center_head import BoxOptions, HeadConfig, TrainRegression
from src.models.heads.decode import AttributeSource, Suppression
from src.models.layers.lift_splat import LiftSplatConfig
from src.models.memory import TemporalConfig
from tests.models.frames import GRID, backbone


def lift_config(**changes):
    values = {
        "image_stride_px": 16,
        "hidden_channels": 16,
        "context_channels": 12,
        "num_depth_bins": 16,
        "depth_range_m": [1.0, 40.0],
        "z_range_m": [-10.0, 10.0],
    }
    return LiftSplatConfig(**(values | changes))


def dense_config(temporal=None, **changes):
    """Smallest configuration; keyword arguments replace weights of the loss and values of the view transform."""
    weights = {"heatmap_weight": 1.0, "box_weight": 0.25, "depth_weight": 1.0}
    weights |= {name: changes.pop(name) for name in list(changes) if name in weights}
    return DenseBEVConfig(
        name="dense_bev",
        channels=16,
        fused_channels=16,
        radar_encoder=PillarConfig(channels=8, num_layers=4),
        view_transform=lift_config(**changes),
        decoder=BEVDecoderConfig(stage_channels=[16, 16, 24], stage_strides=[2, 2, 1], blocks_per_stage=2),
        temporal=temporal,
        head=HeadConfig(
            nms=Suppression.per_group,
            score_threshold=0.1,
            max_boxes=500,
            attributes=AttributeSource.rule,
            train_regression=TrainRegression.sampled,
        ),
        loss=CameraRadarLossConfig(**weights),
    )


def dense_model(seed=0, neck=NeckName.fpn, **changes):
    """A fresh model with the random state fixed."""
    torch.manual_seed(seed)
    return DenseBEV(dense_config(**changes), GRID, backbone(neck), BoxOptions(velocity_code_weight=0.2))


def memory_config(num_frames=3, max_age_s=6.0):
    return TemporalConfig(num_frames=num_frames, max_age_s=max_age_s)
