"""How remembered frames, and the Gaussians of them, come to the present (method 6). Without gradient."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.geometry.constants import constant, where_scalar
from src.geometry.tensor_transforms import IDENTITY, invert_rigid, transform_points_xy, transform_vectors_xy
from src.ops.backend import implementation

Pose = tuple[Tensor, Tensor]
"""global_from_ego [..., 4, 4] and time (s) [...], both float64."""
Shapes = tuple[Tensor, Tensor, Tensor, Tensor]
"""Means, scales, directions and velocities of Gaussians, [N, n, 2] each."""


@torch.no_grad()
def relative_motion(
    now: Pose,  # of B streams
    aug_from_ego: Tensor,  # [B, 4, 4] float32
    past: Pose,  # of their frames, [..., B]
    present: Tensor,  # [..., B] bool
    max_age_s: float,
    max_speed_mps: float,
    newest: bool,  # the first frame along the first axis tells whether a stream's pose jumped since
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # [..., B] bool; [..., B, 4, 4], [..., B] s, both float32; [..., B] bool
    """Which frames a stream remembers; aug_from_past, elapsed time and whether a frame is usable.

    Remembered are those present; with `newest` those in the past, unless the pose jumped. Usable of them is what can
    be driven from there at `max_speed_mps` and is not older than `max_age_s`; the rest does not move, in no time.
    """
    form = implementation(relative_motion_reference)
    return form(now, aug_from_ego, past, present, max_age_s, max_speed_mps, newest)


def relative_motion_reference(
    now: Pose, aug_from_ego: Tensor, past: Pose, present: Tensor, max_age_s: float, max_speed_mps: float, newest: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Plain torch form."""
    ego_from_past, elapsed, driven = relative_pose(now, past, max_speed_mps)
    kept = present
    if newest:
        before = present & (elapsed > 0)
        kept = before & ~(before & ~driven)[:1]
    usable = kept & driven & (elapsed <= max_age_s)
    matrix = aug_from_ego.double() @ ego_from_past
    # What is not usable must not carry NaN or huge numbers into arithmetic that is masked afterwards.
    matrix = torch.where(usable[..., None, None], matrix, constant(IDENTITY, matrix.dtype, matrix.device))
    return kept, matrix.float(), where_scalar(usable, elapsed, 0.0).float(), usable


def relative_pose(
    now: Pose,
    past: Pose,
    max_speed_mps: float,
) -> tuple[Tensor, Tensor, Tensor]:  # [..., 4, 4], [...] s, [...] bool
    """From the past to now in float64, and whether a vehicle can drive it in that time."""
    ego_from_past = invert_rigid(now[0]) @ past[0]
    elapsed = now[1] - past[1]
    distance = ego_from_past[..., :3, 3].norm(dim=-1)
    return ego_from_past, elapsed, (elapsed > 0) & (distance <= max_speed_mps * elapsed)


@torch.no_grad()
def warp_gaussians(
    shapes: Shapes,
    valid: Tensor,  # [N, n] bool
    aug_from_past: Tensor,  # [N, 4, 4]
    elapsed_s: Tensor,  # [N]
    usable: Tensor,  # [N] bool
    min_speed_mps: float | None,  # slower ones stay where they were; None: all do
    grid: BEVGrid,
) -> tuple[Shapes, Tensor]:  # valid [N, n]
    """Gaussians of N frames moved by their velocities and by the ego motion.

    Valid is what was and lies in the grid, of usable frames; the means of the rest are the grid's centre.
    """
    return implementation(warp_gaussians_reference)(
        shapes, valid, aug_from_past, elapsed_s, usable, min_speed_mps, grid
    )


def warp_gaussians_reference(
    shapes: Shapes, valid: Tensor, aug_from_past: Tensor, elapsed_s: Tensor, usable: Tensor,
    min_speed_mps: float | None, grid: BEVGrid,
) -> tuple[Shapes, Tensor]:  # fmt: skip
    """Plain torch form."""
    means, scales, directions, velocities = shapes
    if min_speed_mps is not None:
        means = means + zero_slow_velocities(velocities, min_speed_mps) * elapsed_s[:, None, None]
    matrix = aug_from_past[:, None].to(means.dtype)  # [N, 1, 4, 4]
    means = transform_points_xy(matrix, means)
    valid = valid & usable[:, None] & grid.contains(means)
    return (
        torch.where(valid[..., None], means, constant(grid.centre_m, means.dtype, means.device)),
        scales * torch.linalg.det(matrix[..., :2, :2]).abs().sqrt()[..., None],
        F.normalize(transform_vectors_xy(matrix, directions), dim=-1),
        transform_vectors_xy(matrix, velocities),
    ), valid


def zero_slow_velocities(
    velocities: Tensor,  # [..., 2] m/s
    min_speed_mps: float,
) -> Tensor:  # [..., 2]
    """The velocities, zero where they are slower: what stands must not drift on the error of its speed."""
    if min_speed_mps == 0:
        return velocities
    return velocities * (velocities.norm(dim=-1, keepdim=True) >= min_speed_mps)
