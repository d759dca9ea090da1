"""Random frames of radar and cameras, a driving vehicle and a small image encoder, for models of every family."""

from dataclasses import replace

import torch

from src.geometry.bev_grid import BEVGrid
from src.models.backbones.image import ImageEncoderConfig, NeckName
from src.models.backbones.weights import BackboneName
from src.structures.batch import FrameBatch
from tests.models import moving
from tests.models.surroundings import AXES, random_boxes, rigs

SIZE = (64, 96)  # image height, width
GRID = BEVGrid(cells=(48, 64), cell_m=0.8, centre_m=(2.0, -1.0), z_range_m=(-3.0, 5.0))


def pose(x=0.0, y=0.0, yaw=0.0):
    """global_from_ego [4, 4] far from the origin of the global frame."""
    return moving.pose(x, y, yaw, origin=moving.UTM)


def make_batch(points=(150, 120), boxes=(6, 4), seed=0, images=True, headings=AXES, origin=moving.UTM):
    """Random frames: (points per sample, boxes per sample). Without images the boxes are others, for no pixel is drawn
    before them."""
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
        global_from_ego=torch.stack([moving.pose(origin=origin)] * b),
        aug_from_ego=torch.eye(4).repeat(b, 1, 1),
        radar_points=torch.cat(clouds),
        radar_batch=torch.repeat_interleave(torch.arange(b), torch.tensor(points)),
        images=torch.randint(0, 256, (b, 4, 3, *SIZE), generator=generator, dtype=torch.uint8) if images else None,
        image_valid=torch.ones(b, 4, dtype=torch.bool) if images else None,
        pix_from_aug=rigs(b, SIZE, headings) if images else None,
        boxes=[random_boxes(count, generator) for count in boxes],
    )


def drive(step, origins=(moving.UTM, moving.UTM), **changes):
    """Step k of a drive of two streams at 10 and 20 m/s, half a second a step, each stream augmented in its own way."""
    batch = make_batch(**({"seed": step} | changes))
    b, (first, second) = len(batch), origins
    poses = [moving.pose(5.0 * step, 0.0, 0.02 * step, first), moving.pose(10.0 * step, 1.0, 0.3, second)]
    return replace(
        batch,
        timestamps_s=torch.tensor([100.0 + 0.5 * step, 7.0 + 0.5 * step], dtype=torch.float64)[:b],
        global_from_ego=torch.stack(poses)[:b],
        aug_from_ego=torch.stack([moving.bda(0.1, 1.02), moving.bda(-0.2, 0.97, flip_y=True)])[:b],
        streams=torch.arange(b),
        starts=torch.full((b,), step == 0),
    )


def fill(model, steps, frame=drive):
    """Memory after some frames of the drive."""
    memory = None
    with torch.no_grad():
        for step in range(steps):
            _, memory = model(frame(step), memory)
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
