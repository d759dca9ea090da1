"""What an encoder layer reads of the shape of Gaussians and makes of it anew (method 5.2, 5.4)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from src.geometry.tensor_transforms import rotate, unit_vectors
from src.ops.backend import implementation

LEARNABLE_REACH = 6.0
"""Learnable points lie within half of this many standard deviations (method 5.2)."""
LEAST_LENGTH = 1e-6
"""Least length by which a raw rotation is divided; a shorter one stays shorter than 1."""


@dataclass(frozen=True)
class AttributeLimits:
    """Ranges of refined attributes (method 5.4)."""

    scale_range_m: tuple[float, float]
    max_mean_shift_m: float
    max_speed_mps: float
    velocity_unit_mps: float  # of the raw velocity


def sampling_points(
    offsets: Tensor,  # [B, G, 2 K] logits of the learnable points
    fixed: Tensor,  # [F, 2] in standard deviations
    means: Tensor,  # [B, G, 2] m
    scales: Tensor,  # [B, G, 2] m
    directions: Tensor,  # [B, G, 2]
) -> Tensor:  # [B, G, F + K, 2] m
    """q_k = m + R(theta) (s * phi_k), with a gradient where one is wanted."""
    form = sampling_points_reference if torch.is_grad_enabled() else implementation(sampling_points_reference)
    return form(offsets, fixed, means, scales, directions)


def sampling_points_reference(
    offsets: Tensor, fixed: Tensor, means: Tensor, scales: Tensor, directions: Tensor
) -> Tensor:
    """Plain torch form."""
    learnt = LEARNABLE_REACH * (offsets.sigmoid() - 0.5)
    phi = torch.cat([fixed.expand(*means.shape[:2], -1, -1), learnt.unflatten(-1, (-1, 2))], dim=2)
    local = scales[:, :, None] * phi  # [B, G, P, 2] along and across the direction
    cos, sin = directions[:, :, None].unbind(-1)  # [B, G, 1]
    return means[:, :, None] + torch.stack(rotate(cos, sin, *local.unbind(-1)), dim=-1)


def refined_attributes(
    raw: Tensor,  # [B, G, 9] mean 2, scale 2, rotation 2, opacity 1, velocity 2
    means: Tensor,  # [B, G, 2] m
    lower_m: Tensor,  # [2]
    upper_m: Tensor,  # [2]
    limits: AttributeLimits,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # [B, G, 2] each
    """Means, scales, directions and velocities, with a gradient where one is wanted."""
    plain = torch.is_grad_enabled() or torch.compiler.is_compiling()
    form = refined_attributes_reference if plain else implementation(refined_attributes_reference)
    return form(raw, means, lower_m, upper_m, limits)


def refined_attributes_reference(
    raw: Tensor, means: Tensor, lower_m: Tensor, upper_m: Tensor, limits: AttributeLimits
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Plain torch form."""
    shift = limits.max_mean_shift_m * (2.0 * raw[..., :2].sigmoid() - 1.0)
    return (means + shift).clamp(lower_m, upper_m), *activated_attributes(raw[..., 2:], limits)


def activated_attributes(
    raw: Tensor,  # [..., 7] scale 2, rotation 2, opacity 1, velocity 2
    limits: AttributeLimits,
) -> tuple[Tensor, Tensor, Tensor]:  # [..., 2] each
    """Scales, directions and velocities."""
    scale, rotation, _, velocity = raw.split([2, 2, 1, 2], dim=-1)
    low, high = limits.scale_range_m
    return (
        low + (high - low) * scale.sigmoid(),
        unit_vectors(rotation, eps=LEAST_LENGTH),
        limits.max_speed_mps * torch.tanh(velocity * (limits.velocity_unit_mps / limits.max_speed_mps)),
    )
