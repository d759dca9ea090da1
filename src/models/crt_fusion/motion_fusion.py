"""Motion-guided temporal fusion of CRT-Fusion: past maps carried on by the motion of their cells (its Sec. 3.4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.errors import ConfigError, require_least
from src.geometry.bev_grid import BEVGrid
from src.geometry.tensor_transforms import transform_points_xy, transform_vectors_xy
from src.models.crt_fusion.motion_estimator import CellMotion
from src.models.layers.dense import DenseConvNormReLU, MapConv2d, map_of_rows, rows_of_map
from src.models.layers.norm import MapBatchNorm
from src.models.memory import FrameMemory, RememberedFrame, StoredRows, TemporalConfig, rows_to_remember
from src.ops.bilinear_scatter import bilinear_scatter
from src.ops.concat_conv import concat_conv2d
from src.ops.frame_motion import zero_slow_velocities
from src.structures.batch import FrameBatch


@dataclass(kw_only=True)
class MotionFusionConfig(TemporalConfig):
    """Settings of the temporal part (`model.temporal`). Raises ConfigError for values that cannot work."""

    min_speed_mps: float  # slower cells are moved by the ego motion alone
    occupancy_threshold: float  # cells above are remembered
    max_cells: int  # guard: the most occupied cells of a frame

    def __post_init__(self) -> None:
        super().__post_init__()
        require_least(self, "model.temporal", {"min_speed_mps": 0, "max_cells": 1})
        if not 0 <= self.occupancy_threshold < 1:
            raise ConfigError(
                f"model.temporal.occupancy_threshold={self.occupancy_threshold}: must be in 0..1, 1 excluded"
            )


@dataclass
class StoredCellStack(StoredRows):
    """Remembered cells of all streams, in the ego frame of their time, with T maps of features, newest first."""

    xy: Tensor  # [n, 2] m
    velocities: Tensor  # [n, 2] m/s over ground
    features: Tensor  # [n, T * C] bfloat16
    rows: Tensor  # [n] int64, stream of each, ascending


@dataclass
class StackFrame(RememberedFrame):
    """The last key frame of each of B streams with the maps before it, which have been carried on to its time."""

    ages_s: Tensor  # [B, T] float32, of each map at this time; infinite where there is none
    cells: StoredCellStack

    def with_velocities(self, velocities: Callable[[int, Tensor, Tensor], Tensor]) -> StackFrame:
        """The frame with other velocities of its cells, which carry the maps of every age."""
        told = self.cells.by_stream(velocities, len(self.present), self.cells.xy, self.cells.velocities)
        return replace(self, cells=replace(self.cells, velocities=told))


@dataclass(frozen=True)
class StackMemory(FrameMemory[StackFrame]):
    """The last frame of each of B streams, which has taken in those before it."""

    frame_type = StackFrame


@dataclass
class MovedMaps:
    """Past maps in the current augmented frame, newest first."""

    maps: Tensor  # [B, T * C, rows, cols] float32, zero where nothing is remembered
    ages_s: Tensor  # [B, T] float32, infinite where there is none

    @property
    def usable(self) -> Tensor:  # [B, T] bool
        """Which past maps each stream has."""
        return self.ages_s.isfinite()


class MotionGuidedFusion(nn.Module):
    """Recurrent alignment of past maps, weighted by gates and joined with the current one (MGTF)."""

    norm_pairs = (("refine", "norm"),)

    def __init__(self, config: MotionFusionConfig, channels: int, grid: BEVGrid) -> None:
        super().__init__()
        self.config, self.channels, self.grid = config, channels, grid
        slots = config.num_frames + 1
        self.gates = MapConv2d(slots * channels, slots * channels, 1)
        self.reduce = DenseConvNormReLU(slots * (channels + 1), channels, 1)  # a map and its age each
        self.refine = MapConv2d(channels, channels, 3, padding=1, bias=False)
        self.norm = MapBatchNorm(channels)
        nn.init.zeros_(self.norm.weight)  # untrained, the memory adds exactly zero

    @torch.no_grad()
    def recall(self, memory: StackMemory | None, batch: FrameBatch) -> MovedMaps:
        """All past maps moved at once by the motion of the newest one's cells: x' = A_t T (x + v dt).

        So a cell of an old map moves by what each frame since has predicted where it then was.
        """
        shape = (len(batch), *self.grid.cells)
        slots, width = self.config.num_frames, self.config.num_frames * self.channels
        ages = torch.full((len(batch), slots), torch.inf, device=batch.device)
        frames = memory.before(batch).frames if memory is not None else ()
        if not frames:
            return MovedMaps(map_of_rows(ages.new_zeros(torch.Size(shape).numel(), width), shape), ages)
        frame = frames[0]  # has taken in what was before it
        with torch.autocast(batch.device.type, enabled=False):
            motion, cells = frame.motion(batch, self.config.max_age_s), frame.cells
            ages = torch.where(motion.usable[:, None], frame.ages_s + motion.elapsed_s[:, None], ages)
            ages = torch.where(ages <= self.config.max_age_s, ages, torch.inf)
            moving = zero_slow_velocities(cells.velocities, self.config.min_speed_mps)
            xy = cells.xy + moving * motion.elapsed_s[cells.rows, None]
            xy = transform_points_xy(motion.aug_from_past[cells.rows], xy)
            known = ages.isfinite()[cells.rows].repeat_interleave(self.channels, dim=1)  # [n, T * C]
            features = torch.where(known, cells.features.float(), 0.0)
            maps = bilinear_scatter(features, self.grid.to_cells(xy), cells.rows, shape)
        return MovedMaps(map_of_rows(maps, shape), ages)

    def aggregate(
        self,
        fused: Tensor,  # [B, C, rows, cols]
        moved: MovedMaps,
    ) -> Tensor:  # [B, C, rows, cols]
        """F + norm(refine(reduce([g * [F, M_1, ..., M_T], ages]))) with gates g = sigmoid(W [F, M_1, ..., M_T])."""
        x = torch.cat([fused, moved.maps.to(fused.dtype)], dim=1)
        x = x * self.gates(x).sigmoid()
        ages = F.pad(torch.where(moved.usable, moved.ages_s, 0.0), (1, 0))  # the current map's is 0
        ages = ages[:, :, None, None].expand(-1, -1, *x.shape[2:]).to(x.dtype)
        x = concat_conv2d([x, ages], self.reduce.conv.weight, self.reduce.conv.bias)
        return fused + self.norm(self.refine(F.relu(self.reduce.norm(x))))

    @torch.no_grad()
    def remember(self, batch: FrameBatch, fused: Tensor, motion: CellMotion, moved: MovedMaps) -> StackMemory:
        """The occupied cells of the current map and of those before it, with their velocities, detached."""
        scores = motion.occupancy_logits.sigmoid()
        streams = torch.arange(len(batch), device=batch.device).repeat_interleave(self.grid.rows * self.grid.cols)
        kept = rows_to_remember(scores, streams, self.config.occupancy_threshold, len(batch), self.config.max_cells)
        rows = streams[kept]
        row = torch.div(kept, self.grid.cols, rounding_mode="floor") % self.grid.rows
        ego_from_aug = batch.ego_from_aug[rows]
        older = rows_of_map(moved.maps)[kept, : -self.channels]
        cells = StoredCellStack(
            xy=transform_points_xy(ego_from_aug, self.grid.centre_of(torch.stack([row, kept % self.grid.cols], 1))),
            velocities=transform_vectors_xy(ego_from_aug, motion.velocities[kept]),
            features=torch.cat([rows_of_map(fused)[kept].float(), older], dim=1).to(torch.bfloat16),
            rows=rows,
        )
        present = torch.ones(len(batch), dtype=torch.bool, device=batch.device)
        ages = F.pad(moved.ages_s[:, :-1], (1, 0))
        return StackMemory((StackFrame(batch.timestamps_s, batch.global_from_ego, present, ages, cells),))
