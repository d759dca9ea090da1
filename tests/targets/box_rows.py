"""Boxes from rows of numbers, and the keys of a small grid's cells."""

import torch

from src.geometry.bev_grid import BEVGrid
from src.structures.boxes import Boxes3D

GRID = BEVGrid(cells=(20, 30), cell_m=1.0, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))


def boxes_of(*rows: tuple[float, ...]) -> Boxes3D:
    """Boxes from rows x, y, l, w, yaw, vx, vy."""
    t = torch.tensor(rows, dtype=torch.float32).reshape(-1, 7)
    labels = torch.zeros(len(t), dtype=torch.int64)
    ones = torch.ones(len(t), 1)
    return Boxes3D(
        torch.cat([t[:, :2], ones], 1), torch.cat([t[:, 2:4], ones], 1), t[:, 4], t[:, 5:], labels, labels - 1
    )


def key(sample: int, row: int, col: int) -> int:
    return (sample * 20 + row) * 30 + col
