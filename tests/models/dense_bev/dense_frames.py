"""Random frames, a driving vehicle and a model of a few thousand parameters."""

from dataclasses import replace

import torch

from src.geometry.bev_grid import BEVGrid
from src.models.backbones.bev_decoder import BEVDecoderConfig
from src.models.backbones.image import ImageEncoderConfig, NeckName
from src.models.backbones.pillars import PillarConfig
from src.models.backbones.weights import BackboneName
from src.models.camera_radar import CameraRadarLossConfig
from src.models.dense_bev.model import DenseBEV, DenseBEVConfig
from src.models.heads.center_head import BoxOptions, HeadConfig, TrainRegression
from src.models.heads.decode import AttributeSource, Suppression
from src.models.layers.lift_splat import LiftSplatConfig
from src.models.memory import TemporalConfig
from src.structures.batch import FrameBatch
from tests.models import moving
from tests.models.surroundings import AXES, camera_matrices, random_boxes

SIZE = (64, 96)  # image height, width
GRID = BEVGrid(cells=(48, 64), cell_m=0.8, centre_m=(2.0, -1.0), z_range_m=(-3.0, 5.0))


def pose(x=0.0, y=0.0, yaw=0.0):
    """global_from_ego [4, 4] far from the origin of the global frame."""
    return moving.pose(x, y, yaw, origin=moving.UTM)


def make_batch(points=(150, 120), boxes=(6, 4), seed=0):
    """Random frames: (points per sample, boxes per sample)."""
    generator = torch.Generator().manual_seed(seed)
    b = len(points)
    clouds = []
    for count in points:
        xyz = torch.rand(count, 3, generator=generator) * torch.tensor([48.0, 36.0, 4.0])
        rest = torch.randn(count, 4, generator=generator) * torch.tensor([8.0, 5.0, 5.0, 0.1])
        clouds.append(torch.cat([xyz + torch.tensor([-22.0, -19.0, -1.0]), rest], dim=1))
    return FrameBatch(
        tokens=[f"sample{i}" for i in range(b)],
        timestamps_s=torch.zeros(b, dtype=torch.float64),
        global_from_ego=torch.stack([pose()] * b),
        aug_from_ego=torch.eye(4).repeat(b, 1, 1),
        radar_points=torch.cat(clouds),
        radar_batch=torch.repeat_interleave(torch.arange(b), torch.tensor(points)),
        images=torch.randint(0, 256, (b, 4, 3, *SIZE), generator=generator, dtype=torch.uint8),
        image_valid=torch.ones(b, 4, dtype=torch.bool),
        pix_from_aug=camera_matrices(SIZE, AXES).repeat(b, 1, 1, 1),
        boxes=[random_boxes(count, generator) for count in boxes],
    )


def drive(step, **changes):
    """Step k of a drive of two streams at 10 and 20 m/s, half a second a step, each stream augmented in its own way."""
    batch = make_batch(**({"seed": step} | changes))
    b = len(batch)
    return replace(
        batch,
        timestamps_s=torch.tensor([100.0 + 0.5 * step, 7.0 + 0.5 * step], dtype=torch.float64)[:b],
        global_from_ego=torch.stack([pose(5.0 * step, 0.0, 0.02 * step), pose(10.0 * step, 1.0, 0.3)])[:b],
        aug_from_ego=torch.stack([moving.bda(0.1, 1.02), moving.bda(-0.2, 0.97, flip_y=True)])[:b],
        streams=torch.arange(b),
        starts=torch.full((b,), step == 0),
    )


def fill(model, steps):
    """Memory after some frames of the drive."""
    memory = None
    with torch.no_grad():
        for step in range(steps):
            _, memory = model(drive(step), memory)
    return memory


def backbone(neck=NeckName.fpn):
    return ImageEncoderConfig(
        name=BackboneName.small,
        image_size_px=list(SIZE),
        weights=None,
        lr_multiplier=1.0,
        neck=neck,
        neck_channels=16,
        trim_padding=False,
        widths=[8, 8, 16, 16],
        blocks=[1, 1, 1, 1],
    )


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
