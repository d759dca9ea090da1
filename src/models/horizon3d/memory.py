"""What phase 2 remembers of past key frames, lane by lane, and how it moves to the present (specification 6)."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from src.structures.batch import MAX_EGO_SPEED_MPS, FrameBatch
from src.structures.gaussians import GaussianSet


@dataclass
class StoredCells:
    """BEV cells worth remembering of one key frame of every lane: rows of all lanes, one after the other."""

    xy: Tensor  # [n, 2] m, cell centres in the ego frame of their own time
    velocities: Tensor  # [n, 2] m/s over ground, same axes
    features: Tensor  # [n, C] rows of F_fuse
    rows: Tensor  # [n] int64, row of the batch each cell belongs to, ascending

    def map(self, function: Callable[[Tensor], Tensor]) -> StoredCells:
        """The cells with `function` applied to every tensor."""
        return StoredCells(**{field.name: function(getattr(self, field.name)) for field in fields(self)})


@dataclass
class Motion:
    """How each lane got from a stored frame to the current one."""

    aug_from_past: Tensor  # [B, 4, 4] float32, A_t T_{t-k -> t}
    elapsed_s: Tensor  # [B] float32, dt_k; 0 where not usable
    usable: Tensor  # [B] bool


@dataclass
class MemoryFrame:
    """One remembered key frame of each of B lanes, detached, in unaugmented ego coordinates of its own time."""

    timestamps_s: Tensor  # [B] float64
    global_from_ego: Tensor  # [B, 4, 4] float64
    present: Tensor  # [B] bool, False for a lane whose clip began later
    cells: StoredCells | None
    gaussians: GaussianSet | None  # [B, n]

    def motion(self, batch: FrameBatch, max_age_s: float) -> Motion:
        """From this frame to the batch's, composed in float64.

        Not usable: an absent lane, a frame that is not in the past or older than `max_age_s`, a pose that jumped.
        """
        ego_from_past, elapsed, driven = self._way_to(batch)
        usable = self.present & driven & (elapsed <= max_age_s)
        matrix = batch.aug_from_ego.double() @ ego_from_past
        # What is not usable must not carry NaN or huge numbers into arithmetic that is masked afterwards.
        matrix = torch.where(usable[:, None, None], matrix, torch.eye(4, dtype=matrix.dtype, device=matrix.device))
        return Motion(matrix.float(), torch.where(usable, elapsed, 0.0).float(), usable)

    def jumped(self, batch: FrameBatch) -> Tensor:  # [B] bool
        """Lanes whose pose jumped between this frame and the batch's, which is later."""
        _, elapsed, driven = self._way_to(batch)
        return self.present & (elapsed > 0) & ~driven

    def _way_to(self, batch: FrameBatch) -> tuple[Tensor, Tensor, Tensor]:
        """[B, 4, 4] and [B] s from here to the batch, float64, and whether a vehicle can drive it in that time [B]."""
        ego_from_past = rigid_inverse(batch.global_from_ego) @ self.global_from_ego
        elapsed = batch.timestamps_s - self.timestamps_s
        distance = ego_from_past[:, :3, 3].norm(dim=1)
        return ego_from_past, elapsed, (elapsed > 0) & (distance <= MAX_EGO_SPEED_MPS * elapsed)

    def select(
        self,
        rows: Tensor,  # [B'] int64, distinct where kept
        keep: Tensor,  # [B'] bool
    ) -> MemoryFrame:
        """The lanes at `rows`, those without `keep` forgotten."""
        cells, gaussians = self.cells, self.gaussians
        if cells is not None:
            target = torch.full_like(self.present, -1, dtype=torch.int64)  # new row of every old one
            kept = keep.nonzero().squeeze(1)
            target[rows[kept]] = kept
            moved = target[cells.rows]
            order = moved.argsort(stable=True)
            order = order[moved[order] >= 0]
            cells = replace(cells.map(lambda value: value[order]), rows=moved[order])
        if gaussians is not None:
            gaussians = gaussians.map(lambda value: value[rows])
            gaussians = replace(gaussians, valid=gaussians.valid & keep[:, None])
        return MemoryFrame(
            self.timestamps_s[rows], self.global_from_ego[rows], self.present[rows] & keep, cells, gaussians
        )

    def to(self, device: torch.device | str) -> MemoryFrame:
        """The same frame on another device."""
        return MemoryFrame(
            self.timestamps_s.to(device),
            self.global_from_ego.to(device),
            self.present.to(device),
            None if self.cells is None else self.cells.map(lambda value: value.to(device)),
            None if self.gaussians is None else self.gaussians.map(lambda value: value.to(device)),
        )


@dataclass(frozen=True)
class Memory:
    """The last key frames of each of B lanes, newest first. A value: pushing makes a new one."""

    frames: tuple[MemoryFrame, ...]

    @property
    def batch_size(self) -> int:
        """B, 0 for an empty memory."""
        return len(self.frames[0].present) if self.frames else 0

    def before(self, batch: FrameBatch) -> Memory:
        """What of the memory is in the past of the batch, lane by lane; the rest is forgotten for good.

        Gone are frames that are not older than the batch's, and, where the pose jumped since a lane's last frame, all
        that lies before the jump. Only neighbouring frames tell: over several seconds the same jump could pass for a
        drive.
        """
        if not self.frames:
            return self
        steady = ~self.frames[0].jumped(batch)
        return _shared(
            replace(frame, present=frame.present & steady & (frame.timestamps_s < batch.timestamps_s))
            for frame in self.frames
        )

    def push(self, frame: MemoryFrame, num_cell_frames: int, num_gaussian_frames: int) -> Memory:
        """Put the current frame first and forget what no path looks at any more, so memory never grows."""
        frames = [frame, *self.frames][: max(num_cell_frames, num_gaussian_frames)]
        return Memory(
            tuple(
                replace(
                    old,
                    cells=old.cells if age < num_cell_frames else None,
                    gaussians=old.gaussians if age < num_gaussian_frames else None,
                )
                for age, old in enumerate(frames)
            )
        )

    def select(
        self,
        rows: Tensor,  # [B'] int64, row of each new lane in this memory, distinct where kept
        keep: Tensor,  # [B'] bool, False: the lane starts anew
    ) -> Memory:
        """Memory for a batch whose lanes come from these rows; frames that no lane has any more are dropped."""
        return _shared(frame.select(rows, keep) for frame in self.frames)

    def to(self, device: torch.device | str) -> Memory:
        """The same memory on another device."""
        return Memory(tuple(frame.to(device) for frame in self.frames))

    def state(self) -> list[dict[str, Any]]:
        """Tensors and plain containers, for a checkpoint."""

        def plain(part: Any) -> dict[str, Tensor] | None:
            return None if part is None else {field.name: getattr(part, field.name) for field in fields(part)}

        return [
            plain(frame) | {"cells": plain(frame.cells), "gaussians": plain(frame.gaussians)} for frame in self.frames
        ]

    @classmethod
    def from_state(cls, state: list[dict[str, Any]]) -> Memory:
        """The memory that `state` described."""
        frames = []
        for entry in state:
            cells, gaussians = entry["cells"], entry["gaussians"]
            parts = {
                "cells": None if cells is None else StoredCells(**cells),
                "gaussians": None if gaussians is None else GaussianSet(**gaussians),
            }
            frames.append(MemoryFrame(**(entry | parts)))
        return cls(tuple(frames))


def _shared(frames: Iterable[MemoryFrame]) -> Memory:
    """A memory without the frames that no lane has any more, so that they take no place of others."""
    frames = tuple(frames)
    if not frames:
        return Memory(())
    kept = torch.stack([frame.present.any() for frame in frames]).tolist()  # one look, since a GPU waits for it
    return Memory(tuple(frame for frame, wanted in zip(frames, kept, strict=True) if wanted))


def rigid_inverse(
    dst_from_src: Tensor,  # [..., 4, 4] rotation and translation
) -> Tensor:  # [..., 4, 4]
    """Inverse of rigid transforms, without a general solve."""
    rotation = dst_from_src[..., :3, :3].transpose(-1, -2)
    inverse = torch.zeros_like(dst_from_src)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3] = -(rotation @ dst_from_src[..., :3, 3:]).squeeze(-1)
    inverse[..., 3, 3] = 1.0
    return inverse
