"""From box codes to boxes, whose velocities take their radial part from the radar (method 1.4, 7)."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.geometry.constants import Values, constant
from src.ops.backend import implementation
from src.ops.radial_correction import radial_correction_reference

WIDTHS = (3, 3, 1, 2, 1, 1, 1, 1)
"""Centre, size, yaw, velocity, score, label, attribute, and whether the score is above the threshold."""
YAW, ATTRIBUTE = 6, 11
"""Their columns."""
LOG_SIZE_LIMIT = 5.0
ATTRIBUTE_MOVING_MPS = 0.2
OVERHEAD_M = 3.5
DRIVING_MPS = 1.0
"""What is slower does not drive (CRT-Fusion's least speed)."""
LEAST_COSINE = 0.3
"""Between heading and line of sight; at a wider angle the radial part says too little of the speed."""


def decoded_boxes(
    codes: Tensor,  # [n, 10 or more] dx, dy (cells), z (m), log sizes 3 (log m), cos yaw, sin yaw, velocity 2 (m/s)
    rows: Tensor,  # [n] int64, of their cells
    indices: Tensor,  # [M, 3] int64 (batch, row, col)
    labels: Tensor,  # [n] int64
    scores: Tensor,  # [n]
    threshold: float,
    grid: BEVGrid,
    rules: Values,  # see `attributes_by_rule`
    radar: tuple[Tensor, Tensor] | None,  # `keys` and `measured` of `radial_correction`
    turned: bool,  # then `along_heading`
) -> Tensor:  # [n, sum of WIDTHS]
    """Boxes side by side with scores, labels and attributes by rule. Without gradient."""
    with torch.no_grad():
        return implementation(decoded_boxes_reference)(
            codes, rows, indices, labels, scores, threshold, grid, rules, radar, turned
        )


def decoded_boxes_reference(
    codes: Tensor, rows: Tensor, indices: Tensor, labels: Tensor, scores: Tensor, threshold: float, grid: BEVGrid,
    rules: Values, radar: tuple[Tensor, Tensor] | None, turned: bool,
) -> Tensor:  # fmt: skip
    """Plain torch form."""
    cells = indices.index_select(0, rows)
    velocities = codes[:, 8:10]
    if radar is not None:
        steps = constant((grid.rows * grid.cols, grid.cols, 1), torch.int64, cells.device)
        velocities = radial_correction_reference(velocities, (cells * steps).sum(1), *radar, grid, added=True)
        if turned:
            velocities = along_heading(velocities, codes[:, 6:8], grid.centre_of(cells[:, 1:]))
    centers, sizes, yaws = box_geometry(cells[:, 1:], codes, grid)
    attributes = attributes_by_rule(velocities, centers, sizes, labels, rules)
    single = (scores, labels, attributes, scores > threshold)
    columns = (centers, sizes, yaws[:, None], velocities, *(column[:, None] for column in single))
    return torch.cat([column.to(torch.promote_types(codes.dtype, torch.float32)) for column in columns], dim=1)


def box_geometry(
    cells: Tensor,  # [n, 2] int64 (row, col)
    codes: Tensor,  # [n, 10 or more]
    grid: BEVGrid,
) -> tuple[Tensor, Tensor, Tensor]:  # [n, 3], [n, 3], [n]
    """Centres, sizes and yaws: x = (col + dx) * cell + x_min, sizes = exp(clamp(., -5, 5)), yaw = atan2(sin, cos)."""
    lower = constant((grid.x_min_m, grid.y_min_m), codes.dtype, codes.device)
    xy = (cells.flip(1).to(codes.dtype) + codes[:, :2]) * grid.cell_m + lower
    sizes = codes[:, 3:6].clamp(-LOG_SIZE_LIMIT, LOG_SIZE_LIMIT).exp()
    return torch.cat([xy, codes[:, 2:3]], dim=1), sizes, torch.atan2(codes[:, 7], codes[:, 6])


def attributes_by_rule(
    velocities: Tensor,  # [n, 2] m/s
    centers: Tensor,  # [n, 3] m
    sizes: Tensor,  # [n, 3] m
    labels: Tensor,  # [n] int64
    rules: Values,  # [4, classes] attribute of what stands, what moves, and both with a lower edge above OVERHEAD_M
) -> Tensor:  # [n] int64
    """Attributes by class, speed and height."""
    table = constant(rules, labels.dtype, labels.device)
    high = centers[:, 2] - 0.5 * sizes[:, 2] > OVERHEAD_M
    return table[2 * high + (velocities.norm(dim=1) > ATTRIBUTE_MOVING_MPS), labels]


def along_heading(
    velocities: Tensor,  # [n, 2] m/s over ground
    headings: Tensor,  # [n, 2] cosine and sine of the yaw, of any length
    positions: Tensor,  # [n, 2] m from the ego's origin, same axes
) -> Tensor:  # [n, 2] m/s
    """Velocities of what drives, turned into its heading: they keep their radial part, or the part along the heading.

    The latter where heading and line of sight are nearly at right angles. What is slow stays as it is, and what moves
    more than 45 degrees away from its heading, where one of both is wrong.
    """
    heading, sight = F.normalize(headings, dim=1), F.normalize(positions, dim=1)
    along, radial, cosine = ((a * b).sum(1) for a, b in ((velocities, heading), (velocities, sight), (heading, sight)))
    speed = torch.where(cosine.abs() > LEAST_COSINE, radial / cosine, along)
    stated = velocities.norm(dim=1)
    drives = (stated > DRIVING_MPS) & (along.abs() > math.sqrt(0.5) * stated)
    return torch.where(drives[:, None], speed[:, None] * heading, velocities)
