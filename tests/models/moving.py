"""A vehicle that drives through the world: poses, BEV augmentations and bare frames without sensors."""

import math

import torch

from src.structures.batch import FrameBatch

UTM = (7e5, 5.3e6)


def pose(x=0.0, y=0.0, yaw=0.0, origin=(0.0, 0.0), pitch=0.0):
    """global_from_ego [4, 4] float64 of a vehicle at (x, y) from `origin`, heading `yaw`."""
    c, s = math.cos(yaw), math.sin(yaw)
    turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
    c, s = math.cos(pitch), math.sin(pitch)
    tilt = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = turn @ tilt
    matrix[:2, 3] = torch.tensor([origin[0] + x, origin[1] + y], dtype=torch.float64)
    return matrix


def bda(rotation=0.0, scale=1.0, flip_x=False, flip_y=False):
    """aug_from_ego [4, 4] float32 as A = S R F (method 9)."""
    c, s = scale * math.cos(rotation), scale * math.sin(rotation)
    a, b = -1.0 if flip_x else 1.0, -1.0 if flip_y else 1.0
    return torch.tensor([[c * a, -s * b, 0, 0], [s * a, c * b, 0, 0], [0, 0, scale, 0], [0, 0, 0, 1]])


def bare_frame(time_s, poses, augs=None):
    """B frames at one time (or B times), one pose and one augmentation a stream, nothing seen."""
    b = len(poses)
    times = torch.as_tensor(time_s, dtype=torch.float64).expand(b).clone()
    return FrameBatch(
        tokens=[f"stream{i}" for i in range(b)],
        timestamps_s=times,
        global_from_ego=torch.stack(list(poses)),
        aug_from_ego=torch.stack(list(augs)) if augs is not None else torch.eye(4).repeat(b, 1, 1),
        radar_points=torch.zeros(0, 7),
        radar_batch=torch.zeros(0, dtype=torch.int64),
    )


def tensors_of(memory):
    """All tensors of a memory, flat."""

    def leaves(node):
        if isinstance(node, dict):
            node = list(node.values())
        if isinstance(node, (list, tuple)):
            return [leaf for value in node for leaf in leaves(value)]
        return [node] if isinstance(node, torch.Tensor) else []

    return leaves(memory.state())
