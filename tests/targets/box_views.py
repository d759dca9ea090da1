"""A pinhole camera at the origin and boxes for it to see."""

import math

import torch

from src.structures.boxes import Boxes3D
from src.targets.projection import BoxViews, view_boxes

SIZE = (128, 256)  # H, W
FOCAL = 100.0


def camera(yaw: float = 0.0) -> torch.Tensor:
    """pix_from_aug of a camera at the origin that looks along `yaw`, principal point in the image centre."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    optical = torch.tensor([[sin, -cos, 0, 0], [0, 0, -1, 0], [cos, sin, 0, 0], [0, 0, 0, 1]])
    pinhole = torch.tensor([[FOCAL, 0, 128.0, 0], [0, FOCAL, 64.0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    return (pinhole @ optical).float()


def boxes_at(*rows: tuple[float, ...]) -> Boxes3D:
    """Boxes from rows x, y, z, l, w, h, yaw."""
    t = torch.tensor(rows, dtype=torch.float32).reshape(-1, 7)
    labels = torch.zeros(len(t), dtype=torch.int64)
    return Boxes3D(t[:, :3], t[:, 3:6], t[:, 6], torch.zeros(len(t), 2), labels, labels - 1)


def view(boxes: Boxes3D, cameras: torch.Tensor, valid: bool = True) -> BoxViews:
    """Views of one sample."""
    matrices = cameras.reshape(1, -1, 4, 4)
    batch = torch.zeros(len(boxes), dtype=torch.int64)
    return view_boxes(boxes, batch, matrices, torch.full(matrices.shape[:2], valid), SIZE)
