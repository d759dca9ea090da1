"""What is remembered of each stream: the voxels of V2 of its last frame, with their velocities (lrs 5.5, O10)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from src.models.memory import FrameMemory, RememberedFrame, StoredRows


@dataclass
class StoredVoxels(StoredRows):
    """Remembered voxels of one frame of every stream: rows of all streams, one after the other."""

    xyz: Tensor  # [n, 3] m, voxel centres in the ego frame of their own time
    velocities: Tensor  # [n, 3] m/s over ground, same axes
    features: Tensor  # [n, C] rows of V2
    rows: Tensor  # [n] int64, row of the batch each voxel belongs to, ascending


@dataclass
class VolumeFrame(RememberedFrame):
    """The remembered voxels of one frame of each of B streams, in unaugmented ego coordinates of its own time."""

    voxel_m: tuple[float, ...]  # (x, y, z) edges
    voxels: StoredVoxels

    def with_velocities(self, velocities: Callable[[int, Tensor, Tensor], Tensor]) -> VolumeFrame:
        """Of voxels, over the ground plane."""
        voxels = self.voxels
        flat = voxels.by_stream(velocities, len(self.present), voxels.xyz[:, :2], voxels.velocities[:, :2])
        return replace(self, voxels=replace(voxels, velocities=torch.cat([flat, torch.zeros_like(flat[:, :1])], 1)))


@dataclass(frozen=True)
class VolumeMemory(FrameMemory[VolumeFrame]):
    """The last frame of each of B streams, which has taken in those before it."""

    frame_type = VolumeFrame

    def detached(self) -> VolumeMemory:
        """The memory whose features carry no gradient to the frame that they are of."""
        return self.mapped(lambda frame: frame.map(Tensor.detach))
