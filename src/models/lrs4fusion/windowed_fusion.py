"""Temporal fusion: attention of voxels to the remembered ones around them, moved to the present (lrs 5.5)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from src.errors import ConfigError, require_least
from src.geometry.tensor_transforms import transform_points, transform_vectors
from src.geometry.voxel_grid import VoxelGrid
from src.losses.normalizers import full_precision
from src.models.lrs4fusion.volume_memory import StoredVoxels, VolumeFrame, VolumeMemory
from src.ops.kernel_maps import window_map
from src.ops.segment_reduce import segment_mean
from src.ops.sites import Sites
from src.ops.window_attention import window_attention
from src.structures.batch import FrameBatch
from src.structures.sparse_bev import SparseMap

POSITION_SCALE_M = 100.0


@dataclass(kw_only=True)
class VolumeMemoryConfig:
    """Settings of the temporal part (`model.temporal`). Raises ConfigError for values that cannot work."""

    max_age_s: float  # an older memory is not used
    channels: int  # width of the attention
    num_heads: int
    window: int  # voxels along every axis
    velocity_compensation: bool  # move voxels by their predicted radial speed; off: by the ego motion alone

    def __post_init__(self) -> None:
        require_least(self, "model.temporal", {"channels": 1, "num_heads": 1, "window": 1})
        if not self.max_age_s > 0:
            raise ConfigError(f"model.temporal.max_age_s={self.max_age_s}: must be positive")
        if self.channels % self.num_heads:
            raise ConfigError(
                f"model.temporal.channels={self.channels}: must be a multiple of num_heads={self.num_heads}"
            )
        if self.window not in (1, 3, 5):
            raise ConfigError(f"model.temporal.window={self.window}: must be 1, 3 or 5 voxels")

    @property
    def num_frames(self) -> int:
        """One frame, which has taken in those before it (O10)."""
        return 1


@dataclass
class WarpedVolume:
    """Remembered voxels moved to the present and put into voxels again; those of one voxel are averaged."""

    volume: SparseMap  # [n, C] on (B, z, y, x) of the second scale
    elapsed_s: Tensor  # [B], 0 where nothing is remembered
    ego_mps: Tensor  # [B, 3] the ego's mean velocity since, aug frame; NaN where nothing is remembered


class WindowedFusion(nn.Module):
    """Adds to every current voxel what it sees in the window around it; the sites stay as they are.

    A voxel whose window is empty stays unchanged (O11). Runs in float32 also under autocast: its inputs are positions.
    """

    full_precision_parts = ("",)

    def __init__(self, config: VolumeMemoryConfig, channels: int, memory_channels: int, grid: VoxelGrid) -> None:
        super().__init__()
        self.config, self.grid, self.memory_channels = config, grid, memory_channels
        width = config.channels
        self.query, self.key = _mlp(channels, width, width), _mlp(memory_channels, width, width)
        self.query_position, self.key_position = _mlp(4, width, width), _mlp(4, width, width)
        self.to_query, self.to_key, self.to_value, self.to_out = (nn.Linear(width, width) for _ in range(4))
        self.out = _mlp(width, width, channels)

    def forward(
        self,
        current: SparseMap,  # [M, channels] on (B, z, y, x)
        warped: WarpedVolume,
    ) -> SparseMap:
        with torch.autocast(current.features.device.type, enabled=False):
            past, zeros = warped.volume, torch.zeros_like(warped.elapsed_s)
            features = full_precision(current.features)
            query = self.query(features) + self.query_position(self._place(current.sites, zeros))
            key = self.key(full_precision(past.features)) + self.key_position(self._place(past.sites, warped.elapsed_s))
            window = window_map(past.sites, current.sites, self.config.window)
            heads = (self.config.num_heads, -1)
            projected = (self.to_query(query), self.to_key(key), self.to_value(key))
            seen = window_attention(*(rows.unflatten(1, heads) for rows in projected), window)
            added = self.out(self.to_out(seen.flatten(1)))
            meets = torch.zeros_like(added[:, :1], dtype=torch.bool).index_fill(0, window.outputs.long(), True)
            return current.with_features(features + torch.where(meets, added, 0.0))

    def _place(
        self,
        sites: Sites,
        elapsed_s: Tensor,  # [B]
    ) -> Tensor:  # [n, 4]
        """Centres / 100 m, and the age in seconds."""
        indices = sites.indices()
        return torch.cat([self.grid.centre_of(indices[:, 1:]) / POSITION_SCALE_M, elapsed_s[indices[:, 0]][:, None]], 1)

    def recall(self, memory: VolumeMemory | None, batch: FrameBatch) -> WarpedVolume:
        """The remembered voxels in the batch's augmented frame: p' = A_t T (p + v dt); outside the grid they are lost.

        Without a usable memory, after a jump of the pose for instance, the volume has no sites. Differentiable in the
        remembered features. Raises ValueError for a memory of another number of streams, voxel size or width.
        """
        shape = (len(batch), *self.grid.cells)
        frames = memory.frames if memory is not None else ()
        for frame in frames:
            self._check(frame)
        frames = memory.before(batch).frames if frames else ()
        if not frames:
            keys = torch.zeros(0, dtype=torch.int64, device=batch.device)
            empty = batch.aug_from_ego.new_zeros(0, self.memory_channels)
            nothing = torch.zeros_like(batch.aug_from_ego[:, :3, 3])
            return WarpedVolume(SparseMap(Sites(shape, keys), empty), nothing[:, 0], nothing + torch.nan)
        voxels, motion = frames[0].voxels, frames[0].motion(batch, self.config.max_age_s)
        xyz = voxels.xyz
        if self.config.velocity_compensation:
            xyz = xyz + voxels.velocities * motion.elapsed_s[voxels.rows][:, None]
        xyz = transform_points(motion.aug_from_past[voxels.rows], xyz)
        kept = (motion.usable[voxels.rows] & self.grid.contains(xyz)).nonzero().squeeze(1)
        indices = torch.cat([voxels.rows[:, None], self.grid.cell_of(xyz)], dim=1)[kept]
        sites, owners = Sites.unique(indices, shape)
        features = segment_mean(full_precision(voxels.features)[kept], owners, len(sites))
        driven = -motion.aug_from_past[:, :3, 3] / motion.elapsed_s.clamp(min=torch.finfo(torch.float32).eps)[:, None]
        ego_mps = torch.where(motion.usable[:, None], driven, torch.nan)
        return WarpedVolume(SparseMap(sites, features), motion.elapsed_s, ego_mps)

    def _check(self, frame: VolumeFrame) -> None:
        if frame.voxel_m != self.grid.voxel_m or frame.voxels.features.shape[1] != self.memory_channels:
            raise ValueError(
                f"the memory holds {frame.voxels.features.shape[1]} channels in voxels of {frame.voxel_m} m, but this "
                f"model remembers {self.memory_channels} in voxels of {self.grid.voxel_m} m; start the streams without "
                "memory"
            )

    @torch.no_grad()
    def _in_ego(
        self,
        volume: SparseMap,  # V2
        velocities_mps: Tensor | None,  # [M, 3] over ground, aug frame; None: all at rest
        batch: FrameBatch,
    ) -> tuple[Tensor, Tensor]:  # [M, 3] m, [M, 3] m/s
        """Centres and velocities of the voxels in the unaugmented ego frame."""
        indices = volume.indices
        ego_from_aug = batch.ego_from_aug[indices[:, 0]]
        centres = self.grid.centre_of(indices[:, 1:])
        velocities = torch.zeros_like(centres) if velocities_mps is None else velocities_mps
        return transform_points(ego_from_aug, centres), transform_vectors(ego_from_aug, velocities)

    def remember(
        self,
        volume: SparseMap,  # V2
        velocities_mps: Tensor | None,  # [M, 3] over ground, aug frame; None: all at rest
        batch: FrameBatch,
    ) -> VolumeMemory:
        """The memory of the next frame, whose features carry their gradient on."""
        xyz, velocities = self._in_ego(volume, velocities_mps, batch)
        voxels = StoredVoxels(xyz, velocities, volume.features, volume.indices[:, 0])
        present = torch.ones_like(batch.timestamps_s, dtype=torch.bool)
        frame = VolumeFrame(batch.timestamps_s, batch.global_from_ego, present, self.grid.voxel_m, voxels)
        return VolumeMemory((frame,))


def _mlp(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, hidden), nn.LayerNorm(hidden), nn.GELU(), nn.Linear(hidden, outputs))
