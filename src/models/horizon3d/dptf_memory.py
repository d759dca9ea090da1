"""What phase 2 remembers of past key frames, stream by stream: cells and Gaussians (method 6)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from src.models.memory import FrameMemory, RememberedFrame, StoredRows
from src.structures.gaussians import GaussianSet


def stored_features(features: Tensor) -> Tensor:
    """Features as they are remembered: under autocast in its type."""
    if not torch.is_autocast_enabled(features.device.type):
        return features
    return features.to(torch.get_autocast_dtype(features.device.type))


@dataclass
class StoredCells(StoredRows):
    """Remembered BEV cells of one key frame of every stream: rows of all streams, one after the other."""

    xy: Tensor  # [n, 2] m, cell centres in the ego frame of their own time
    velocities: Tensor  # [n, 2] m/s over ground, same axes
    features: Tensor  # [n, C] rows of F_fuse
    rows: Tensor  # [n] int64, row of the batch each cell belongs to, ascending


@dataclass
class DPTFFrame(RememberedFrame):
    """One remembered key frame of each of B streams, detached, in unaugmented ego coordinates of its own time."""

    cells: StoredCells | None
    gaussians: GaussianSet | None  # [B, n]

    def select(
        self,
        rows: Tensor,  # [B'] int64, distinct where kept
        keep: Tensor,  # [B'] bool
    ) -> DPTFFrame:
        """The streams at `rows`, those without `keep` forgotten."""
        frame = super().select(rows, keep)
        if frame.gaussians is None:
            return frame
        return replace(frame, gaussians=replace(frame.gaussians, valid=frame.gaussians.valid & keep[:, None]))

    def with_velocities(self, velocities: Callable[[int, Tensor, Tensor], Tensor]) -> DPTFFrame:
        """The frame with other velocities of its cells and its Gaussians."""
        cells, gaussians = self.cells, self.gaussians
        if cells is not None:
            told = cells.by_stream(velocities, len(self.present), cells.xy, cells.velocities)
            cells = replace(cells, velocities=told)
        if gaussians is not None:
            rows = range(len(self.present))
            parts = [velocities(row, gaussians.means[row], gaussians.velocities[row]) for row in rows]
            gaussians = replace(gaussians, velocities=torch.stack(parts))
        return replace(self, cells=cells, gaussians=gaussians)


@dataclass(frozen=True)
class DPTFMemory(FrameMemory[DPTFFrame]):
    """The last key frames of each of B streams, newest first. A value: pushing makes a new one."""

    frame_type = DPTFFrame

    def push(self, frame: DPTFFrame, num_cell_frames: int, num_gaussian_frames: int) -> DPTFMemory:
        """Put the current frame first and drop what no path reads any more, so that memory stays bounded."""
        frames = [frame, *self.frames][: max(num_cell_frames, num_gaussian_frames)]
        return DPTFMemory(
            tuple(
                replace(
                    old,
                    cells=old.cells if age < num_cell_frames else None,
                    gaussians=old.gaussians if age < num_gaussian_frames else None,
                )
                for age, old in enumerate(frames)
            )
        )
