"""Queries of the past: kept, moved to the present by their velocity and the ego motion, told of it (StreamPETR)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.errors import require_least
from src.geometry.bev_grid import BEVGrid
from src.geometry.tensor_transforms import transform_points, transform_vectors_xy
from src.models.heads.query_head import QueryPrediction
from src.models.layers.feed_forward import scale_shift_linear
from src.models.memory import FrameMemory, RememberedFrame, TemporalConfig, motions
from src.ops.frame_motion import zero_slow_velocities
from src.ops.take_rows import take_rows
from src.structures.batch import FrameBatch
from src.structures.evidence import Evidence, WarpedPoints
from src.structures.queries import UNKNOWN_LOGIT, Queries
from src.structures.taxonomy import CLASSES, SPEED_UNIT_MPS

MOTION_NUMBERS = 7
"""Age (s), velocity (2), ego displacement (2) and its turn as cosine and sine (2)."""

EGO_UNIT_M = 10.0


@dataclass(kw_only=True)
class QueryMemoryConfig(TemporalConfig):
    """Settings of the temporal part (`model.temporal`). Raises ConfigError when there is nothing to remember."""

    queries_per_frame: int  # the best of each; those of the newest frame look again
    min_speed_mps: float  # slower ones are moved by the ego motion alone

    def __post_init__(self) -> None:
        super().__post_init__()
        require_least(self, "model.temporal", {"queries_per_frame": 1, "min_speed_mps": 0})


@dataclass
class QueryFrame(RememberedFrame):
    """The best queries of one key frame of each of B streams, detached, in the ego frame of their own time."""

    centers: Tensor  # [B, K, 3] m, of their boxes
    velocities: Tensor  # [B, K, 2] m/s over ground
    features: Tensor  # [B, K, C]
    logits: Tensor  # [B, K, 12] of their classes
    valid: Tensor  # [B, K] bool

    def with_velocities(self, velocities: Callable[[int, Tensor, Tensor], Tensor]) -> QueryFrame:
        """The frame with other velocities of its queries."""
        streams = enumerate(zip(self.centers[..., :2], self.velocities, strict=True))
        return replace(self, velocities=torch.stack([velocities(row, xy, own) for row, (xy, own) in streams]))


@dataclass(frozen=True)
class QueryMemory(FrameMemory[QueryFrame]):
    """The last key frames of each of B streams, newest first."""

    frame_type = QueryFrame


@dataclass
class RecalledQueries:
    """Remembered queries in the present."""

    past: tuple[QueryFrame, ...]  # of the batch (`FrameMemory.before`), at most as many as configured
    queries: Queries  # [B, T * K], newest frame first
    elapsed_s: Tensor  # [B, T * K]
    usable: Tensor  # [B, T] bool, which past frames each stream has
    per_frame: int  # K

    @property
    def newest(self) -> Queries:
        """Queries of the last frame."""
        return self.queries.map(lambda value: value[:, : self.per_frame])

    @property
    def older(self) -> Queries:
        """Queries of the frames before the last."""
        return self.queries.map(lambda value: value[:, self.per_frame :])

    def diagnostics(self) -> dict[str, Tensor | float]:
        """What is remembered, per stream."""
        streams = len(self.usable)
        return {
            "remembered_frames": self.usable.sum() / streams,
            "remembered_queries": self.queries.valid.sum() / streams,
        }

    def evidence(self) -> Evidence:
        """Where the remembered queries of the first stream are now."""
        known = self.queries.valid[0]
        queries = self.queries.map(lambda value: value[0][known])
        return Evidence(
            warped_queries=WarpedPoints(queries.centers[:, :2], queries.velocities, self.elapsed_s[0][known], True)
        )


class MotionNorm(nn.Module):
    """Layer norm whose scale and shift follow from motion (StreamPETR's motion-aware layer normalisation)."""

    full_precision_parts = ("",)

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.motion = nn.Linear(MOTION_NUMBERS, channels)
        self.scale_shift = scale_shift_linear(channels)  # untrained, it is a plain layer norm

    def forward(
        self,
        features: Tensor,  # [..., C]
        motion: Tensor,  # [..., MOTION_NUMBERS]
    ) -> Tensor:  # [..., C] float32
        with torch.autocast(features.device.type, enabled=False):
            scale, shift = self.scale_shift(F.relu(self.motion(motion.float()))).chunk(2, dim=-1)
            return scale * F.layer_norm(features.float(), features.shape[-1:]) + shift


class QueryPropagation(nn.Module):
    """Remembers the best queries of each frame and brings them back."""

    def __init__(self, config: QueryMemoryConfig, channels: int, grid: BEVGrid) -> None:
        super().__init__()
        self.config, self.channels, self.grid = config, channels, grid
        self.norm = MotionNorm(channels)

    def recall(self, memory: QueryMemory | None, batch: FrameBatch) -> RecalledQueries:
        """The remembered queries in the batch's augmented frame: x' = A_t T (x + v dt).

        Of those that are too old, not in the past or outside the grid nothing is valid; frames that are missing are
        padding, so that shapes are always the same.
        """
        past = memory.before(batch).frames[: self.config.num_frames] if memory is not None else ()
        frames = [*past, *[self._nothing(batch)] * (self.config.num_frames - len(past))]
        motion = motions(frames, batch, self.config.max_age_s)  # [T, B]
        centers, velocities, features, logits, valid = (
            torch.stack([getattr(frame, name) for frame in frames])
            for name in ("centers", "velocities", "features", "logits", "valid")
        )  # [T, B, K, ...]
        with torch.autocast(batch.device.type, enabled=False):
            elapsed = motion.elapsed_s[..., None].expand_as(valid)
            driven = motion.aug_from_past[:, :, None]  # [T, B, 1, 4, 4]
            shift = zero_slow_velocities(velocities, self.config.min_speed_mps) * elapsed[..., None]
            centers = transform_points(driven, centers + F.pad(shift, (0, 1)))
            velocities = transform_vectors_xy(driven, velocities)
            valid = valid & motion.usable[..., None] & self.grid.contains(centers[..., :2])
            centers = torch.where(valid[..., None], centers, 0.0)
            driven = driven.expand(*valid.shape, 4, 4)
            told = [elapsed[..., None], velocities / SPEED_UNIT_MPS, driven[..., :2, 3] / EGO_UNIT_M]
            features = self.norm(features, torch.cat([*told, driven[..., :2, 0]], dim=-1))
        logits = logits.clamp(UNKNOWN_LOGIT, 0.0)  # what a frame adds to them must not add up over many
        queries = Queries(features, centers, velocities, logits, valid).map(_by_sample)
        return RecalledQueries(past, queries, _by_sample(elapsed), motion.usable.t(), self.config.queries_per_frame)

    @torch.no_grad()
    def remember(
        self,
        past: tuple[QueryFrame, ...],  # of `RecalledQueries`
        batch: FrameBatch,
        features: Tensor,  # [B, Q, C]
        prediction: QueryPrediction,
    ) -> QueryMemory:
        """The past with the best queries of the batch added."""
        wanted = self.config.queries_per_frame
        scores = torch.where(prediction.valid, prediction.logits.amax(-1), -torch.inf)
        best, picks = scores.topk(min(wanted, scores.shape[1]), dim=1)
        ego_from_aug = batch.ego_from_aug[:, None]
        codes = take_rows(prediction.codes, picks)
        centers, velocities = codes[..., :3], codes[..., -2:]
        frame = QueryFrame(
            batch.timestamps_s,
            batch.global_from_ego,
            torch.ones_like(batch.timestamps_s, dtype=torch.bool),
            centers=_padded(transform_points(ego_from_aug, centers), wanted),
            velocities=_padded(transform_vectors_xy(ego_from_aug, velocities), wanted),
            features=_padded(take_rows(features.float(), picks), wanted),
            logits=_padded(take_rows(prediction.logits.float(), picks), wanted),
            valid=_padded(best.isfinite()[..., None], wanted).squeeze(-1),
        )
        return QueryMemory((frame, *past)[: self.config.num_frames])

    def _nothing(self, batch: FrameBatch) -> QueryFrame:
        """A frame in which no stream remembers anything."""
        shape, device = (len(batch), self.config.queries_per_frame), batch.device
        sizes = {"centers": 3, "velocities": 2, "features": self.channels, "logits": len(CLASSES)}
        return QueryFrame(
            batch.timestamps_s,
            batch.global_from_ego,
            torch.zeros(len(batch), dtype=torch.bool, device=device),
            **{name: torch.zeros(*shape, size, device=device) for name, size in sizes.items()},
            valid=torch.zeros(shape, dtype=torch.bool, device=device),
        )


def _by_sample(value: Tensor) -> Tensor:  # [T, B, K, ...] -> [B, T * K, ...]
    return value.transpose(0, 1).flatten(1, 2)


def _padded(value: Tensor, count: int) -> Tensor:  # [B, k, c] -> [B, count, c]
    return F.pad(value.detach(), (0, 0, 0, count - value.shape[1]))
