"""The memory of one stream in fixed shapes: tensors of full size, which tell themselves what of them is remembered."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from src.geometry.constants import constant, where_scalar
from src.geometry.tensor_transforms import transform_points_xy
from src.models.horizon3d.bev_path import BEVPath, CellPrediction, PaddedWarpedCells
from src.models.horizon3d.dptf import DPTF, WarpedMemory
from src.models.horizon3d.dptf_memory import DPTFFrame, DPTFMemory, StoredCells, stored_features
from src.models.horizon3d.gaussian_path import GaussianPath
from src.models.horizon3d.output import Horizon3DOutput
from src.models.memory import Motion, RememberedFrame
from src.ops.cell_keys import cell_centres, cell_keys
from src.ops.frame_motion import zero_slow_velocities
from src.ops.sites import HALO
from src.structures.batch import FrameBatch
from src.structures.gaussians import GaussianSet
from src.structures.sparse_bev import SparseBEV
from src.structures.taxonomy import Source

FRAME_WIDTH = 20
"""Numbers of a frame: time (s), pose [4, 4]; whether it, its cells and its Gaussians are there."""
CELL_WIDTH, GAUSSIAN_WIDTH = 5, 10
"""Numbers of a cell and of a Gaussian without its features, which stand before the last number.

A cell: position 2, velocity 2, whether it is there. A Gaussian: mean, scales, direction, velocity 2 each, opacity
logit, whether it is there.
"""


@dataclass(frozen=True)
class FixedMemory:
    """What `DPTFMemory` holds of one stream, newest first; a frame that is not there is zeros."""

    frames: Tensor  # [T, FRAME_WIDTH] float64
    cells: Tensor  # [T_c, K, CELL_WIDTH + C] float32; T_c is 0 without the BEV path
    gaussians: Tensor  # [T_g, n, GAUSSIAN_WIDTH + C] float32; T_g is 0 without the Gaussian path

    @property
    def tensors(self) -> tuple[Tensor, Tensor, Tensor]:
        """All tensors of the memory."""
        return self.frames, self.cells, self.gaussians

    @classmethod
    def empty(cls, dptf: DPTF, channels: int, device: torch.device) -> FixedMemory:
        """A memory without frames, on the device."""
        cells = gaussians = (0, 0)
        if dptf.bev_path is not None:
            cells = (dptf.bev_path.config.num_frames, dptf.bev_path.config.max_cells_per_frame)
        if dptf.gaussian_path is not None:
            gaussians = (dptf.gaussian_path.config.num_frames, dptf.gaussian_path.config.gaussians_per_frame)
        return cls(
            torch.zeros(dptf.config.num_frames, FRAME_WIDTH, dtype=torch.float64, device=device),
            torch.zeros(*cells, CELL_WIDTH + channels, device=device),
            torch.zeros(*gaussians, GAUSSIAN_WIDTH + channels, device=device),
        )

    @classmethod
    def of(cls, memory: DPTFMemory, dptf: DPTF, channels: int, device: torch.device) -> FixedMemory:
        """`memory`, which is of one stream, in fixed shapes."""
        fixed = cls.empty(dptf, channels, device)
        for age, frame in enumerate(memory.to(device).frames):
            held = torch.tensor([frame.cells is not None, frame.gaussians is not None], device=device)
            row = (frame.timestamps_s, frame.global_from_ego.flatten(), frame.present, held)
            fixed.frames[age] = torch.cat([x.double() for x in row])
            if frame.cells is not None:
                fixed.cells[age, : len(frame.cells.rows)] = _cell_rows(frame.cells)
            if frame.gaussians is not None:
                fixed.gaussians[age] = _gaussian_rows(frame.gaussians)[0]
        return fixed

    def to_memory(self) -> DPTFMemory:
        """The inverse of `of`: tensors as large as what is remembered, in float32. Waits for a GPU."""
        frames = []
        for age, row in enumerate(self.frames.unbind(0)):
            present, has_cells, has_gaussians = (row[-3:] > 0).tolist()
            if not present:
                continue
            cells = gaussians = None
            if has_cells:
                kept = self.cells[age][self.cells[age, :, -1] > 0]
                xy, velocities, features, _ = kept.split([2, 2, kept.shape[1] - CELL_WIDTH, 1], dim=1)
                cells = StoredCells(xy, velocities, features, torch.zeros_like(xy[:, 0], dtype=torch.int64))
            if has_gaussians:
                gaussians = _gaussians_of(self.gaussians[age : age + 1])
            pose = row[1:17].view(1, 4, 4)
            frames.append(DPTFFrame(row[:1], pose, torch.ones_like(row[:1], dtype=torch.bool), cells, gaussians))
        return DPTFMemory(tuple(frames))

    def recall(self, dptf: DPTF, batch: FrameBatch) -> tuple[WarpedMemory, Tensor]:  # and [T] bool
        """As `DPTF.recall`, less the memory itself: instead, which frames stay in it (`DPTFMemory.before`)."""
        held = self.frames[:, 17:] > 0  # [T, 3]
        stored = RememberedFrame(self.frames[:, :1], self.frames[:, 1:17].view(-1, 1, 4, 4), held[:, :1])
        kept, motion = stored.stacked_motion(batch, dptf.config.max_age_s)
        history = warped = None
        if dptf.gaussian_path is not None:
            history = self._history(dptf.gaussian_path, held[:, 2:], motion, dptf.config.min_speed_mps)
        if dptf.bev_path is not None:
            warped = self._warped(dptf.bev_path, kept, held[:, 1:2], motion, dptf.config.min_speed_mps)
        return WarpedMemory(DPTFMemory(()), history, warped), kept.squeeze(1)

    def _history(self, path: GaussianPath, held: Tensor, motion: Motion, min_speed_mps: float) -> GaussianSet:
        num, past = len(self.gaussians), _gaussians_of(self.gaussians)
        usable = motion.usable[:num] & held[:num]
        return path.move(past, Motion(motion.aug_from_past[:num], motion.elapsed_s[:num], usable), min_speed_mps)

    def _warped(
        self, path: BEVPath, kept: Tensor, held: Tensor, motion: Motion, min_speed_mps: float
    ) -> PaddedWarpedCells:  # kept, held: [T, 1] bool
        """As `BEVPath.recall`; cells that are not there are padding."""
        num, width, grid = len(self.cells), self.cells.shape[2], path.grid
        xy, velocities, features, valid = self.cells.split([2, 2, width - CELL_WIDTH, 1], dim=2)  # [T, K, ...] each
        elapsed = motion.elapsed_s[:num]  # [T, 1]
        if path.config.velocity_compensation:
            xy = xy + zero_slow_velocities(velocities, min_speed_mps) * elapsed[:, :, None]
        xy = transform_points_xy(motion.aug_from_past[:num], xy)
        found = (valid > 0) & (motion.usable[:num] & held[:num])[:, :, None]  # [T, K, 1]
        slots = path.config.num_frames - kept[:num].cumsum(0)  # [T, 1], a frame for each that is kept
        # Slots stand for samples, as many as make the key of padding that of padding among sites on `path.shape`.
        shape = (path.shape(1)[1] + HALO, *grid.cells)
        corner, size = (grid.x_min_m, grid.y_min_m), (grid.cell_m, grid.cell_m)
        keys = cell_keys(xy.flatten(0, 1), slots.flatten(), found.flatten(), corner, size, shape, xy.dtype)
        return PaddedWarpedCells(keys, elapsed.flatten(), features.flatten(0, 1))

    def pushed(
        self,
        kept: Tensor,  # [T] bool, see `recall`
        batch: FrameBatch,
        output: Horizon3DOutput,
        dptf: DPTF,
        overflow: Tensor,  # [] bool
    ) -> FixedMemory:
        """The memory with the current frame added; as it was where that has overflowed."""
        num = len(self.frames)
        # Of the new frame (0), the old ones and one that is none: which comes first, second, ...
        stay = F.pad(kept, (1, 0), value=True)
        same = constant(tuple(range(1, num + 1)), torch.int64, stay.device)
        order = torch.where(overflow, same, torch.nonzero_static(stay, size=num, fill_value=num + 1).flatten())
        there = constant((1.0,) * 3, torch.float64, order.device)
        none = constant(((0.0,) * FRAME_WIDTH,), torch.float64, order.device)
        row = torch.cat([batch.timestamps_s, batch.global_from_ego.flatten(), there])
        frames = torch.cat([row[None], self.frames, none])
        paths = (num, len(self.cells), len(self.gaussians))
        held = tuple((1,) * 17 + tuple(int(age < count) for count in paths) for age in range(num))
        frames = frames.index_select(0, order) * constant(held, torch.float64, order.device)
        cells, gaussians = self.cells, self.gaussians
        if dptf.bev_path is not None:
            best = _best_cells(dptf.bev_path, output.fused_bev, output.dptf.cells, cells.shape[1])
            cells = _taken(best, cells, order)
        if dptf.gaussian_path is not None:
            candidates = dptf.candidates(output.fused_bev, output.dptf, output.ocsf)
            gaussians = _taken(_chosen_gaussians(dptf.gaussian_path, *candidates, batch), gaussians, order)
        return FixedMemory(frames, cells, gaussians)


def _taken(
    new: Tensor,  # [1, n, width]
    old: Tensor,  # [T', n, width]
    order: Tensor,  # [T] int64, of the new frame and the old ones
) -> Tensor:  # [T', n, width]
    """The first T' of both in this order; of no meaning where there is no frame."""
    return torch.cat([new, old]).index_select(0, order[: len(old)].clamp(max=len(old)))


def _best_cells(
    path: BEVPath, fused: SparseBEV, cells: CellPrediction, count: int
) -> Tensor:  # [1, count, CELL_WIDTH + C]
    """Rows of the cells that `BEVPath.store` keeps of a frame that is not augmented, padded to `count`."""
    score = cells.occupancy_logits.sigmoid()
    chosen = (score > path.config.memory_threshold) & (fused.sites.keys < fused.sites.end)
    best = where_scalar(chosen, score, -1.0).argsort(descending=True, stable=True)[:count]
    features = stored_features(fused.features)
    columns = (cell_centres(fused.sites.keys, path.grid), cells.velocities, features.float(), chosen[:, None].float())
    rows = torch.cat(columns, dim=1).index_select(0, best)
    return F.pad(rows, (0, 0, 0, count - len(rows)))[None] if len(rows) < count else rows[None]


def _cell_rows(cells: StoredCells) -> Tensor:  # [n, CELL_WIDTH + C]
    return torch.cat([cells.xy, cells.velocities, cells.features.float(), torch.ones_like(cells.xy[:, :1])], dim=1)


def _chosen_gaussians(
    path: GaussianPath, gaussians: GaussianSet, active: Tensor, batch: FrameBatch
) -> Tensor:  # [1, n, GAUSSIAN_WIDTH + C]
    """Rows of the Gaussians that `GaussianPath.store` keeps of a frame that is not augmented."""
    picks = path.sample(gaussians, active, batch)[0]
    stored = replace(gaussians, features=stored_features(gaussians.features))
    rows = _gaussian_rows(stored)[0].index_select(0, picks.clamp(min=0))
    return torch.cat([rows[:, :-1], (picks >= 0).float()[:, None]], dim=1)[None]


def _gaussian_rows(gaussians: GaussianSet) -> Tensor:  # [B, n, GAUSSIAN_WIDTH + C]
    pairs = (gaussians.means, gaussians.scales, gaussians.directions, gaussians.velocities)
    rest = (gaussians.opacity_logits[..., None], gaussians.features.float(), gaussians.valid[..., None].float())
    return torch.cat([*pairs, *rest], dim=2)


def _gaussians_of(
    rows: Tensor,  # [T, n, GAUSSIAN_WIDTH + C]
) -> GaussianSet:  # [T, n]
    widths = [2, 2, 2, 2, 1, rows.shape[2] - GAUSSIAN_WIDTH, 1]
    means, scales, directions, velocities, opacity, features, valid = rows.split(widths, dim=2)
    return GaussianSet(
        means=means,
        scales=scales,
        directions=directions,
        opacity_logits=opacity.squeeze(2),
        velocities=velocities,
        features=features,
        sources=torch.full(rows.shape[:2], int(Source.HISTORY), device=rows.device),
        elapsed_s=torch.zeros_like(opacity.squeeze(2)),
        valid=valid.squeeze(2) > 0,
    )
