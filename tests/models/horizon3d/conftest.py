"""A model of a few thousand parameters and random frames to feed it."""

import pytest
import torch

from src.geometry.bev_grid import BEVGrid
from src.models.backbones.image import ImageEncoderConfig, NeckName
from src.models.backbones.sparse_voxel import ConvOut, RadarEncoderConfig
from src.models.backbones.weights import BackboneName
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
from src.models.layers.views import CameraViews
from src.structures.batch import FrameBatch
from src.targets.depth import DepthTarget
from tests.models.surroundings import DIAGONALS, camera_matrices, random_boxes

SIZE = (64, 96)  # image height, width


@pytest.fixture
def grid():
    return BEVGrid(cells=(48, 64), cell_m=0.8, centre_m=(2.0, -1.0), z_range_m=(-3.0, 5.0))


@pytest.fixture
def make_batch():
    """Random frames: (points per sample, boxes per sample) -> FrameBatch."""

    def build(points=(150, 120), boxes=(6, 4), seed=0, images=True):
        generator = torch.Generator().manual_seed(seed)
        b = len(points)
        clouds, owners = [], []
        for sample, count in enumerate(points):
            xyz = torch.rand(count, 3, generator=generator) * torch.tensor([48.0, 36.0, 4.0])
            xyz = xyz + torch.tensor([-22.0, -19.0, -1.0])
            rest = torch.randn(count, 4, generator=generator) * torch.tensor([8.0, 5.0, 5.0, 0.1])
            clouds.append(torch.cat([xyz, rest], dim=1))
            owners.append(torch.full((count,), sample))
        return FrameBatch(
            tokens=[f"sample{i}" for i in range(b)],
            timestamps_s=torch.zeros(b, dtype=torch.float64),
            global_from_ego=torch.eye(4, dtype=torch.float64).repeat(b, 1, 1),
            aug_from_ego=torch.eye(4).repeat(b, 1, 1),
            radar_points=torch.cat(clouds),
            radar_batch=torch.cat(owners),
            images=torch.randint(0, 256, (b, 4, 3, *SIZE), generator=generator, dtype=torch.uint8) if images else None,
            image_valid=torch.ones(b, 4, dtype=torch.bool) if images else None,
            pix_from_aug=camera_matrices(SIZE, DIAGONALS).repeat(b, 1, 1, 1) if images else None,
            boxes=[random_boxes(count, generator) for count in boxes],
        )

    return build


@pytest.fixture
def make_views():
    """Random image features of the four cameras for b samples."""

    def build(b=1, strides=(8, 16, 32), channels=16):
        levels = [torch.randn(b, 4, channels, SIZE[0] // stride, SIZE[1] // stride) for stride in strides]
        return CameraViews(
            levels, camera_matrices(SIZE, DIAGONALS).repeat(b, 1, 1, 1), torch.ones(b, 4, dtype=torch.bool), SIZE
        )

    return build


@pytest.fixture
def backbone():
    return ImageEncoderConfig(
        name=BackboneName.small,
        image_size_px=list(SIZE),
        weights=None,
        lr_multiplier=1.0,
        neck=NeckName.fpn,
        neck_channels=16,
        trim_padding=False,
        widths=[8, 8, 16, 16],
        blocks=[1, 1, 1, 1],
    )


@pytest.fixture
def make_config():
    """Smallest configuration with every part on; keyword arguments replace values of kggi, ocsf and loss by name."""

    def build(radar_only=False, dptf=None, doppler=(), **changes):
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
            head=head_config(),
            loss=Horizon3DLossConfig(**loss),
        )

    return build


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


@pytest.fixture
def make_model(make_config, grid, backbone):
    """A fresh model with the random state fixed."""

    def build(seed=0, **changes):
        torch.manual_seed(seed)
        return Horizon3D(make_config(**changes), grid, backbone, BoxOptions(velocity_code_weight=0.2))

    return build


@pytest.fixture
def make_dptf():
    """`dptf_config`, for tests of this folder, which cannot import this file by its name."""
    return dptf_config
