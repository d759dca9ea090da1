"""The Gaussians that a frame starts from, those of all sources side by side, without gradient (method 4.4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from src.ops.backend import implementation
from src.ops.gaussian_shapes import AttributeLimits, activated_attributes

NUM_RAW = 7
"""Raw scale 2, rotation 2, opacity 1, velocity 2."""


class Attributes(NamedTuple):
    """Attributes of B x G Gaussians, with the names and meaning of `structures.gaussians.GaussianSet`."""

    means: Tensor  # [B, G, 2] m
    scales: Tensor  # [B, G, 2] m
    directions: Tensor  # [B, G, 2]
    opacity_logits: Tensor  # [B, G]
    velocities: Tensor  # [B, G, 2] m/s
    features: Tensor  # [B, G, C]
    sources: Tensor  # [B, G] int64
    elapsed_s: Tensor  # [B, G]
    valid: Tensor  # [B, G] bool


@dataclass(frozen=True, eq=False)
class Keypoints:
    """What one source found."""

    means: Tensor  # [B, K, 2] m
    valid: Tensor  # [B, K] bool
    change: Tensor | None  # [B, K, C + 7] of features and raw attributes


@dataclass(frozen=True, eq=False)
class Slots:
    """What Gaussians start with, by their rank: those of keypoints, source by source, then those with learnt means."""

    values: Tensor  # [K, C + 7] features and raw attributes
    sources: Tensor  # [K] int64
    learnt_means: Tensor  # [K', 2] m, of the last ones
    history_shift: Tensor  # [C], what features of history change by

    @property
    def channels(self) -> int:
        """Number of feature channels C."""
        return self.values.shape[1] - NUM_RAW


@torch.no_grad()
def initial_gaussians(
    slots: Slots,
    keypoints: Sequence[Keypoints],  # of two sources, or of none
    history: Attributes | None,
    centre_m: Tensor,  # [2], the mean of what is no keypoint
    limits: AttributeLimits,
    batch_size: int,
) -> Attributes:
    """Keypoints, those with learnt means, and history as it is."""
    return implementation(initial_gaussians_reference)(slots, keypoints, history, centre_m, limits, batch_size)


def initial_gaussians_reference(
    slots: Slots,
    keypoints: Sequence[Keypoints],
    history: Attributes | None,
    centre_m: Tensor,
    limits: AttributeLimits,
    batch_size: int,
) -> Attributes:
    """Plain torch form."""
    learnt = slots.learnt_means.expand(batch_size, -1, -1)
    valid = [*(one.valid for one in keypoints), learnt.new_ones(learnt.shape[:2], dtype=torch.bool)]
    valid = torch.cat(valid, dim=1)
    means = torch.cat([*(one.means.float() for one in keypoints), learnt], dim=1)
    parts = slots.values.split([*(one.valid.shape[1] for one in keypoints), learnt.shape[1]])
    changes = [*(one.change for one in keypoints), None]
    parts = [
        part.expand(batch_size, -1, -1) if change is None else part + change
        for part, change in zip(parts, changes, strict=True)
    ]
    features = [part[..., :-NUM_RAW] for part in parts]
    raw = torch.cat([part[..., -NUM_RAW:] for part in parts], dim=1)
    scales, directions, velocities = activated_attributes(raw, limits)
    now = Attributes(
        means=torch.where(valid[..., None], means, centre_m),
        scales=scales,
        directions=directions,
        opacity_logits=raw[..., 4],
        velocities=velocities,
        features=torch.cat(features, dim=1),
        sources=slots.sources.expand_as(valid),
        elapsed_s=torch.zeros_like(valid, dtype=torch.float32),
        valid=valid,
    )
    if history is None:
        return now
    history = history._replace(features=history.features + slots.history_shift)
    return Attributes(*(torch.cat(pair, dim=1) for pair in zip(now, history, strict=True)))
