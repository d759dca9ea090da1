"""Cameras around a vehicle and boxes near it."""

import math

import torch

from src.structures.boxes import Boxes3D

DIAGONALS = (45.0, -45.0, -135.0, 135.0)
AXES = (0.0, -90.0, 180.0, 90.0)


def camera_matrices(size, headings_deg):
    """Cameras 2 m up, 90 degrees wide, one a heading (left of ahead): [N, 4, 4] pixels from the aug frame."""
    height, width = size
    matrices = []
    for degrees in headings_deg:
        yaw = math.radians(degrees)
        forward, right = (math.cos(yaw), math.sin(yaw), 0.0), (math.sin(yaw), -math.cos(yaw), 0.0)
        rotation = torch.tensor([right, (0.0, 0.0, -1.0), forward])
        focal = width / 2
        intrinsics = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
        matrix = torch.eye(4)
        matrix[:3, :3] = intrinsics @ rotation
        matrix[:3, 3] = intrinsics @ (rotation @ torch.tensor([0.0, 0.0, -2.0]))
        matrices.append(matrix)
    return torch.stack(matrices)


def rigs(count, size, headings_deg):
    """`camera_matrices` for each of some samples, [B, N, 4, 4]: each rig is turned by 0.07 further than the one before
    and stands a metre aside, so that one sample's calibration is wrong for another."""
    found = []
    for number in range(count):
        c, s = math.cos(0.07 * number), math.sin(0.07 * number)
        moved = torch.tensor([[c, -s, 0, 0], [s, c, 0, number], [0, 0, 1, 0], [0, 0, 0, 1]])
        with torch.autocast("cpu", enabled=False):  # a test may make its frames within one
            found.append(camera_matrices(size, headings_deg) @ moved)
    return torch.stack(found)


def random_boxes(count, generator):
    spread, corner = torch.tensor([40.0, 30.0, 1.0]), torch.tensor([-18.0, -16.0, 0.0])
    centers = torch.rand(count, 3, generator=generator) * spread + corner
    return Boxes3D(
        centers=centers,
        sizes=torch.tensor([4.5, 1.9, 1.6]).expand(count, 3) * (0.5 + torch.rand(count, 1, generator=generator)),
        yaws=torch.rand(count, generator=generator) * 6.0,
        velocities=torch.randn(count, 2, generator=generator) * 5.0,
        labels=torch.arange(count) % 12,
        attributes=torch.full((count,), -1),
        num_points=torch.full((count,), 5),
    )
