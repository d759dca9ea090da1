"""Gaussian path of DPTF: which Gaussians are remembered, and how they return as history (method 6.2)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.errors import ConfigError, require_least
from src.geometry.bev_grid import BEVGrid
from src.geometry.constants import constant, where_scalar
from src.models.horizon3d.dptf_memory import DPTFFrame, DPTFMemory, stored_features
from src.models.horizon3d.time_embedding import TimeEmbedding
from src.models.memory import Motion, motions
from src.ops.farthest_point import farthest_points
from src.ops.frame_motion import warp_gaussians
from src.ops.take_rows import take_rows
from src.structures.batch import FrameBatch
from src.structures.gaussians import GaussianSet
from src.structures.taxonomy import Source


class Sampling(Enum):
    """Which active Gaussians are remembered (Table 7)."""

    farthest_point = "farthest_point"
    top_opacity = "top_opacity"
    random = "random"


class VelocityFrom(Enum):
    """Whose velocity a remembered Gaussian has: its own, or that of the cell of F_fuse where it contributes most."""

    gaussian = "gaussian"
    cells = "cells"


@dataclass(kw_only=True)
class SelfAttentionConfig:
    """Settings of the temporal self-attention (`model.dptf.gaussian_path.self_attention`)."""

    num_heads: int

    def __post_init__(self) -> None:
        key = "model.dptf.gaussian_path.self_attention"
        require_least(self, key, {"num_heads": 1}, "; self_attention=null switches it off")


@dataclass(kw_only=True)
class GaussianPathConfig:
    """Settings of the Gaussian path (`model.dptf.gaussian_path`)."""

    num_frames: int  # remembered key frames
    gaussians_per_frame: int
    min_contribution: float  # of a Gaussian to an occupied cell, to be active; 0: its support reaches one
    sampling: Sampling
    velocity_from: VelocityFrom
    velocity_compensation: bool  # move history by its own velocity; off: by the ego motion alone (Table 6)
    forget_refuted: bool  # what is no longer active once refined does not return from the frame that remembers it
    self_attention: SelfAttentionConfig | None

    def __post_init__(self) -> None:
        own = {"num_frames": 1, "gaussians_per_frame": 1}
        require_least(self, "model.dptf.gaussian_path", own, "; gaussian_path=null switches the path off")
        if not 0 <= self.min_contribution < 1:
            raise ConfigError(
                f"model.dptf.gaussian_path.min_contribution={self.min_contribution}: must be at least 0 and below 1"
            )

    @property
    def num_history_gaussians(self) -> int:
        """K_hist."""
        return self.num_frames * self.gaussians_per_frame


class GaussianPath(nn.Module):
    """Remembers a covering subset of the active Gaussians and brings it back as history (method 6.2)."""

    def __init__(self, config: GaussianPathConfig, channels: int, grid: BEVGrid) -> None:
        super().__init__()
        self.config, self.channels, self.grid = config, channels, grid
        self.time = TimeEmbedding(channels)
        self.register_buffer("centre_m", torch.tensor(grid.centre_m), persistent=False)
        self.fixed_capacity = False  # pad history to K_hist, so that shapes are static

    def merge_for_inference(self) -> None:
        """History keeps a fixed number of places."""
        self.fixed_capacity = True

    def recall(
        self, memory: DPTFMemory, batch: FrameBatch, max_age_s: float, min_speed_mps: float = 0.0
    ) -> GaussianSet | None:
        """History Gaussians in the batch's augmented frame, newest first; None when nothing is remembered, unless the
        capacity is fixed.

        m' = A_t T (m + v dt), slower ones than `min_speed_mps` stay where they were; what is too old, not in the past
        or outside the grid is padding.
        """
        frames = [frame for frame in memory.frames if frame.gaussians is not None]
        parts = [self._warp(frames, batch, max_age_s, min_speed_mps)] if frames else []
        missing = self.config.num_history_gaussians - sum(map(len, parts))
        if self.fixed_capacity and missing > 0:
            parts.append(self._padding(len(batch), missing))
        return GaussianSet.concatenate(parts, dim=1) if parts else None

    def _warp(self, frames: list[DPTFFrame], batch: FrameBatch, max_age_s: float, min_speed_mps: float) -> GaussianSet:
        """The Gaussians of T frames in one batch: launches cost more than the arithmetic."""
        sets = [frame.gaussians for frame in frames]
        return self.move(GaussianSet.concatenate(sets, dim=0), motions(frames, batch, max_age_s), min_speed_mps)

    def move(
        self,
        past: GaussianSet,  # [T * B, n]
        motion: Motion,  # [T, B]
        min_speed_mps: float,
    ) -> GaussianSet:  # [B, T * n]
        """Remembered Gaussians of T frames as history."""
        elapsed, speed = motion.elapsed_s.flatten(), min_speed_mps if self.config.velocity_compensation else None
        shapes, valid = warp_gaussians(
            (past.means, past.scales, past.directions, past.velocities),
            past.valid,
            *(motion.aug_from_past.flatten(0, 1), elapsed, motion.usable.flatten(), speed, self.grid),
        )
        means, scales, directions, velocities = shapes
        elapsed = elapsed[:, None].expand_as(valid)
        moved = replace(
            past,
            means=means,
            scales=scales,
            directions=directions,
            velocities=velocities,
            features=past.features + self.time(elapsed),
            sources=constant((int(Source.HISTORY),), past.sources.dtype, past.sources.device).expand_as(past.sources),
            elapsed_s=elapsed,
            valid=valid,
        )
        # Sample by sample, newest first.
        return moved.map(lambda value: value.unflatten(0, motion.usable.shape).transpose(0, 1).flatten(1, 2))

    def _padding(self, batch_size: int, count: int) -> GaussianSet:
        ones = self.centre_m.new_ones(batch_size, count, 2)
        zeros = self.centre_m.new_zeros(batch_size, count)
        return GaussianSet(
            means=self.centre_m.expand_as(ones),
            scales=ones,
            directions=ones * math.sqrt(0.5),
            opacity_logits=zeros,
            velocities=torch.zeros_like(ones),
            features=self.centre_m.new_zeros(batch_size, count, self.channels),
            sources=zeros.new_full(zeros.shape, int(Source.HISTORY), dtype=torch.int64),
            elapsed_s=zeros,
            valid=zeros.bool(),
        )

    def without_refuted(
        self,
        memory: DPTFMemory,  # that `recall` read
        history: GaussianSet,  # what it gave, K_hist of each sample
        active: Tensor,  # [B, G] bool, of all refined Gaussians, history last
    ) -> DPTFMemory:
        """The memory less the Gaussians that returned as history and are not active any more."""
        refuted = (history.valid & ~active[:, -history.valid.shape[1] :]).split(self.config.gaussians_per_frame, dim=1)
        refuted = iter(refuted)

        def confirmed(frame: DPTFFrame) -> DPTFFrame:
            if frame.gaussians is None:
                return frame
            return replace(frame, gaussians=replace(frame.gaussians, valid=frame.gaussians.valid & ~next(refuted)))

        return memory.mapped(confirmed)

    @torch.no_grad()
    def store(
        self,
        gaussians: GaussianSet,  # G_L
        active: Tensor,  # [B, G] bool
        batch: FrameBatch,
    ) -> GaussianSet:  # [B, gaussians_per_frame] in the unaugmented ego frame
        """A subset of the active Gaussians of any source; padding where fewer are active."""
        picks = self.sample(gaussians, active, batch)
        rows = picks.clamp(min=0)
        chosen = gaussians.map(lambda value: take_rows(value.detach(), rows))
        ego = chosen.transform(batch.ego_from_aug)
        return replace(ego, features=stored_features(ego.features), valid=picks >= 0)

    def sample(
        self,
        gaussians: GaussianSet,
        active: Tensor,  # [B, G] bool
        batch: FrameBatch,
    ) -> Tensor:  # [B, gaussians_per_frame] int64, -1 for none
        """Which of the active Gaussians are remembered."""
        count, active = self.config.gaussians_per_frame, active & gaussians.valid
        opacity = gaussians.opacity_logits.detach()
        if self.config.sampling is Sampling.farthest_point:
            start = where_scalar(active, opacity, -torch.inf).argmax(dim=1)
            return farthest_points(gaussians.means.detach(), active, start, count)
        score = opacity if self.config.sampling is Sampling.top_opacity else _random_scores(batch, active)
        score, picks = where_scalar(active, score, -torch.inf).topk(min(count, active.shape[1]), dim=1)
        picks = where_scalar(score > -torch.inf, picks, -1)
        return F.pad(picks, (0, count - picks.shape[1]), value=-1)


def _random_scores(batch: FrameBatch, active: Tensor) -> Tensor:  # [B, G] in 0..1
    """Random numbers seeded by each frame's time stamp, so that an evaluation is repeatable."""
    rows = []
    for stamp in batch.timestamps_s.tolist():
        generator = torch.Generator().manual_seed(round(1e6 * stamp) % 2**63)
        rows.append(torch.rand(active.shape[1], generator=generator))
    return torch.stack(rows).to(active.device)
