"""A model of a few thousand parameters."""

import torch

from src.models.backbones.sparse_voxel import ConvOut, RadarEncoderConfig
from src.models.heads.center_head import BoxOptions, HeadConfig, TrainRegression
from src.models.heads.decode import AttributeSource, Suppression
from src.models.horizon3d.bev_path import BEVPathConfig
from src.models.horizon3d.dptf import DPTFConfig
from src.models.horizon3d.gaussian_path import GaussianPathConfig, Sampling, SelfAttentionConfig, VelocityFrom
from src.models.horizon3d.kggi import Initialization, KGGIConfig
from src.models.horizon3d.loss import Horizon3DLossConfig, VelocityGroups
from src.models.horizon3d.model import Horizon3D
from src.models.horizon3d.model_config import Horizon3DConfig
from src.models.horizon3d.ocsf import CrossAttention, OCSFConfig, RefineFrom
from src.models.layers.doppler import DopplerConfig
from src.targets.depth import DepthTarget
from tests.models.frames import GRID, backbone


def make_config(radar_only=False, dptf=None, doppler=(), **changes):
    """Smallest configuration with every part on; keyword arguments replace values of kggi, ocsf and loss by name."""
    kggi = {
        "initialization": Initialization.both,
        "num_radar_keypoints": 24,
        "num_camera_keypoints": 12,
        "num_random_keypoints": 8,
        "num_radar_peaks": 0,
        "num_depth_bins": 16,
        "depth_range_m": [1.0, 40.0],
        "depth_target": DepthTarget.box,
        "keypoint_nms_cells": None,
        "property_head": True,
        "source_embedding_std": 1.0,
    }
    ocsf = {
        "num_layers": 2,
        "num_learnable_points": 3,
        "margin_m": 4.8,
        "occupancy_threshold": 0.1,
        "max_occupied_cells": 2000,
        "scale_range_m": [0.2, 3.2],
        "max_mean_shift_m": 4.0,
        "max_speed_mps": 60.0,
        "velocity_unit_mps": 1.0,
        "support_sigmas": 3.0,
        "cross_attention": CrossAttention.parallel,
        "refine_from": RefineFrom.self_encoding,
        "gate_kernel_size": 1,
        "identity_start": False,
    }
    loss = {
        "kggi_weight": 1.0,
        "ocsf_weight": 5.0,
        "heatmap_weight": 1.0,
        "box_weight": 0.25,
        "keypoint_weight": 1.0,
        "depth_weight": 1.0,
        "radar_objectness_weight": 1.0,
        "occupancy_focal_weight": 1.0,
        "occupancy_dice_weight": 1.0,
        "dptf_weight": 1.0,
        "cell_focal_weight": 1.0,
        "cell_dice_weight": 1.0,
        "cell_lovasz_weight": 1.0,
        "cell_velocity_weight": 0.25,
        "gaussian_velocity_weight": 0.25,
        "velocity_groups": VelocityGroups.boxes,
        "gaussian_velocity_in_phase1": False,
    }
    for part in (kggi, ocsf, loss):
        part.update({name: changes.pop(name) for name in list(changes) if name in part})
    assert not changes
    return Horizon3DConfig(
        name="horizon3d",
        channels=16,
        radar_encoder=RadarEncoderConfig(
            voxel_size_m=[0.8, 0.8, 8.0],
            stage_channels=[16, 16],
            blocks_per_stage=1,
            max_voxels=10000,
            conv_out=ConvOut.subm,
            norm_momentum=0.01,
            point_count_channel=True,
            local_means=True,
            height_tolerance_deg=0.0,
            pruning_ratio=0.0,
        ),
        kggi=None if radar_only else KGGIConfig(**kggi),
        ocsf=None if radar_only else OCSFConfig(**ocsf),
        dptf=dptf,
        doppler=DopplerConfig(
            **{name: name in doppler for name in ("gaussians", "cells", "boxes")},
            in_losses=True,
            along_heading=False,
        ),
        neck_channels=[],
        head=head_config(),
        loss=Horizon3DLossConfig(**loss),
    )


def dptf_config(bev_path=True, gaussian_path=True, max_age_s=6.0, min_speed_mps=0.0, **changes):
    """A small memory with both paths; keyword arguments replace values of either path by name."""
    bev = {
        "num_frames": 3,
        "memory_threshold": 0.1,
        "max_cells_per_frame": 200,
        "velocity_compensation": True,
        "spatial_dilation": False,
    }
    gaussian = {
        "num_frames": 2,
        "gaussians_per_frame": 8,
        "min_contribution": 0.0,
        "sampling": Sampling.farthest_point,
        "velocity_from": VelocityFrom.gaussian,
        "velocity_compensation": True,
        "forget_refuted": False,
        "self_attention": SelfAttentionConfig(num_heads=4),
    }
    for part in (bev, gaussian):
        part.update({name: value for name, value in changes.items() if name in part})
    assert changes.keys() <= bev.keys() | gaussian.keys()
    return DPTFConfig(
        max_age_s=max_age_s,
        min_speed_mps=min_speed_mps,
        bev_path=BEVPathConfig(**bev) if bev_path else None,
        gaussian_path=GaussianPathConfig(**gaussian) if gaussian_path else None,
    )


def head_config():
    return HeadConfig(
        nms=Suppression.per_group,
        score_threshold=0.1,
        max_boxes=500,
        attributes=AttributeSource.rule,
        train_regression=TrainRegression.all,
    )


def make_model(seed=0, **changes):
    """A fresh model with the random state fixed."""
    torch.manual_seed(seed)
    return Horizon3D(make_config(**changes), GRID, backbone(), BoxOptions(velocity_code_weight=0.2))
