"""Small LRS4Fusion models and LiDAR frames for tests."""

from dataclasses import replace

import torch

from src.config import compose_config
from src.geometry.bev_grid import BEVGrid
from src.models import build_model
from tests.models.moving import bare_frame, pose

OVERRIDES = ("model=lrs4fusion", "phase=lrs_detection", "data=synthetic", "data.world.lidar=true")
GRID = BEVGrid((128, 128), 0.8, (0.0, 0.0), (-6.0, 6.0))


def lrs_config(*overrides, scale="debug"):
    return compose_config([*OVERRIDES, f"scale={scale}", *overrides])[0]


def lrs_model(*overrides, scale="debug"):
    torch.manual_seed(0)
    config = lrs_config(*overrides, scale=scale)
    return build_model(config.model, GRID, None, config.phase.options)


def cloud(count, seed=0, spread_m=30.0):
    """Points x, y, z (m), intensity, dt (s): most on the ground, some above it."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(count, 5, generator=generator)
    points[:, :2] = (points[:, :2] - 0.5) * 2 * spread_m
    points[:, 2] = torch.where(points[:, 2] < 0.7, 0.0, points[:, 2] * 3)
    return points * torch.tensor([1.0, 1.0, 1.0, 50.0, 0.1])


def lidar_frame(clouds, time_s=0.0, poses=None, boxes=None):
    """One key frame of each of len(clouds) streams, of points [P, 5] in the aug frame."""
    frame = bare_frame(time_s, poses or [pose()] * len(clouds))
    counts = torch.tensor([len(points) for points in clouds])
    return replace(
        frame,
        lidar_points=torch.cat(clouds),
        lidar_batch=torch.arange(len(clouds)).repeat_interleave(counts),
        boxes=boxes,
    )
