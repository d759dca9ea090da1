"""BEV path of DPTF: remember occupied cells, warp them to the present, aggregate them (Eq. 7-8, Fig. 5; method 6.1)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.errors import ConfigError, require_least
from src.geometry.bev_grid import BEVGrid
from src.geometry.constants import repeat_interleave
from src.geometry.tensor_transforms import transform_points_xy, transform_vectors_xy
from src.models.horizon3d.dptf_memory import DPTFMemory, StoredCells, stored_features
from src.models.horizon3d.time_embedding import TimeEmbedding
from src.models.layers.doppler import Doppler
from src.models.layers.full_precision import FullPrecisionLinear
from src.models.layers.merging import block_diagonal, joined_convs
from src.models.layers.sparse import ConvNormReLU, RowBatchNorm, SubmanifoldConv, TemporalConv
from src.models.memory import motions, rows_to_remember
from src.ops.fixed_shapes import fixed_shapes
from src.ops.frame_motion import zero_slow_velocities
from src.ops.segment_reduce import gather_rows, segment_mean
from src.ops.sites import Sites, places_among
from src.structures.batch import FrameBatch
from src.structures.sparse_bev import SparseBEV, SparseMap
from src.structures.taxonomy import SPEED_UNIT_MPS

OCCUPANCY_BIAS = -4.6
"""An untrained cell is occupied with probability 0.01, well below the memory threshold (method 6.1)."""
TIME_CHANNELS = 32
NORM = {"eps": 1e-5, "momentum": 0.1}


@dataclass(kw_only=True)
class BEVPathConfig:
    """Settings of the BEV path (`model.dptf.bev_path`)."""

    num_frames: int  # remembered key frames
    memory_threshold: float  # tau_mem, occupancy from which a cell is remembered
    max_cells_per_frame: int  # guard: the most occupied cells of a frame
    velocity_compensation: bool  # move cells by their own velocity; off: by the ego motion alone (Table 6)
    spatial_dilation: bool  # literal strided convolutions, which spread every cell to its neighbours

    def __post_init__(self) -> None:
        own = {"num_frames": 1, "max_cells_per_frame": 1}
        require_least(self, "model.dptf.bev_path", own, "; bev_path=null switches the path off")
        if not 0 <= self.memory_threshold < 1:
            raise ConfigError(
                f"model.dptf.bev_path.memory_threshold={self.memory_threshold}: must be at least 0 and below 1"
            )


@dataclass
class CellPrediction:
    """Predictions of the two heads for the cells of F_fuse (Eq. 7)."""

    occupancy_logits: Tensor  # [M] float32, delta before its sigmoid
    velocities: Tensor  # [M, 2] float32, u in m/s over ground, augmented axes
    loss_velocities: Tensor  # [M, 2] those that losses see, see `DopplerConfig`


@dataclass
class WarpedCells:
    """Remembered cells at their position in the current augmented frame, inside the grid; several may share a cell."""

    indices: Tensor  # [n, 4] int64 (batch, slot, row, col), the oldest slot first, the current frame's last
    xy: Tensor  # [n, 2] m, before quantisation
    velocities: Tensor  # [n, 2] m/s over ground, augmented axes
    elapsed_s: Tensor  # [n]
    features: Tensor  # [n, C]


@dataclass
class PaddedWarpedCells:
    """Remembered cells of one stream in fixed shapes; those that are nowhere are padding."""

    keys: Tensor  # [T * K] int64 among sites on `BEVPath.shape`, frame after frame
    elapsed_s: Tensor  # [T]
    features: Tensor  # [T * K, C]


class BEVPath(nn.Module):
    """Sparse memory of occupied BEV cells (method 6.1)."""

    def __init__(self, config: BEVPathConfig, channels: int, grid: BEVGrid) -> None:
        super().__init__()
        self.config, self.grid = config, grid
        self.occupancy = _cell_head(channels, 1)
        # None once the other predicts both (`prepare_for_inference`).
        self.velocity: nn.ModuleList | None = _cell_head(channels, 2)
        nn.init.constant_(self.occupancy[1].bias, OCCUPANCY_BIAS)
        self.time = TimeEmbedding(TIME_CHANNELS)
        self.convs, self.norms = nn.ModuleList(), nn.ModuleList()
        slots, width = self.num_slots, channels + TIME_CHANNELS
        while slots > 1:
            self.convs.append(TemporalConv(width, channels, config.spatial_dilation))
            self.norms.append(RowBatchNorm(channels, **NORM))
            slots, width = (slots + 1) // 2, channels
        # Untrained, the path adds exactly zero. A ReLU after this norm would sit at 0 and never pass a gradient.
        nn.init.zeros_(self.norms[-1].weight)

    @property
    def num_slots(self) -> int:
        """T, the remembered frames and the current one."""
        return self.config.num_frames + 1

    @property
    def norm_pairs(self) -> list[tuple[str, str]]:
        """Each temporal convolution has its norm."""
        return [(f"convs.{number}", f"norms.{number}") for number in range(len(self.convs))]

    def merge_for_inference(self) -> None:
        """Occupancy and velocity read the same cells: one convolution and one linear layer for both."""
        (occupancy, first), (velocity, second) = self.occupancy, self.velocity
        occupancy.conv = joined_convs([occupancy.conv, velocity.conv])
        self.occupancy = nn.ModuleList([occupancy, block_diagonal([first, second])])
        self.velocity = None

    def predict(self, fused: SparseBEV, doppler: Doppler | None = None) -> CellPrediction:
        """Occupancy and velocity of every cell of F_fuse; with `doppler` the radial part is the measured one."""
        values: list[Tensor] = []
        for head in (self.occupancy, self.velocity):
            if head is not None:
                values.append(head[1](head[0](fused).features))
        if self.velocity is None:
            values = list(values[0].split([1, 2], dim=1))
        regressed = SPEED_UNIT_MPS * values[1]
        velocities = regressed if doppler is None else doppler.correct(regressed, fused.sites.linear())
        in_losses = doppler is None or doppler.config.in_losses
        return CellPrediction(values[0].squeeze(1), velocities, velocities if in_losses else regressed)

    @torch.no_grad()
    def store(self, fused: SparseBEV, cells: CellPrediction, batch: FrameBatch) -> StoredCells:
        """Cells above the memory threshold, detached, in the unaugmented ego frame."""
        scores, limit = cells.occupancy_logits.sigmoid(), self.config.max_cells_per_frame
        kept = rows_to_remember(scores, fused.indices[:, 0], self.config.memory_threshold, len(batch), limit)
        indices = fused.indices[kept]
        ego_from_aug = batch.ego_from_aug[indices[:, 0]]  # [n, 4, 4]
        return StoredCells(
            xy=transform_points_xy(ego_from_aug, self.grid.centre_of(indices[:, 1:])),
            velocities=transform_vectors_xy(ego_from_aug, cells.velocities.detach()[kept]),
            features=stored_features(fused.features.detach()[kept]),
            rows=indices[:, 0],
        )

    @torch.no_grad()
    def recall(
        self, memory: DPTFMemory, batch: FrameBatch, max_age_s: float, min_speed_mps: float = 0.0
    ) -> WarpedCells | None:
        """Remembered cells in the batch's augmented frame (Eq. 8); None when nothing is remembered.

        x' = A_t T (x + u dt), always from the original frame, so positions are quantised once; slower ones than
        `min_speed_mps` stay where they were.
        """
        ages = [age for age, frame in enumerate(memory.frames) if frame.cells is not None]
        if not ages:
            return None
        # All frames in one batch: launches cost more than the arithmetic.
        motion = motions([memory.frames[age] for age in ages], batch, max_age_s)
        cells = [memory.frames[age].cells for age in ages]
        slots = [
            torch.full_like(past.rows, self.config.num_frames - 1 - age) for age, past in zip(ages, cells, strict=True)
        ]
        frame = torch.cat([number * len(batch) + past.rows for number, past in enumerate(cells)])  # [n] row in [T * B]
        matrix, elapsed = motion.aug_from_past.flatten(0, 1)[frame], motion.elapsed_s.flatten()[frame]
        xy, velocities, features, rows = (
            torch.cat([getattr(past, name) for past in cells]) for name in ("xy", "velocities", "features", "rows")
        )
        if self.config.velocity_compensation:
            xy = xy + zero_slow_velocities(velocities, min_speed_mps) * elapsed[:, None]
        xy = transform_points_xy(matrix, xy)
        kept = (motion.usable.flatten()[frame] & self.grid.contains(xy)).nonzero().squeeze(1)
        indices = torch.cat([rows[:, None], torch.cat(slots)[:, None], self.grid.cell_of(xy)], dim=1)
        values = (indices, xy, transform_vectors_xy(matrix, velocities), elapsed, features)
        return WarpedCells(*(value[kept] for value in values))

    def shape(self, batch_size: int) -> tuple[int, int, int, int]:
        """Shape of the grid over time: (B, slots, rows, cols)."""
        return batch_size, self.num_slots, *self.grid.cells

    def aggregate(self, fused: SparseBEV, warped: WarpedCells | PaddedWarpedCells | None) -> SparseBEV:
        """F_out = F_fuse + what sparse convolutions over time make of both, on the sites of either."""
        over_time = self._over_time_padded if isinstance(warped, PaddedWarpedCells) else self._over_time
        x = over_time(fused, warped)
        for number, (conv, norm) in enumerate(zip(self.convs, self.norms, strict=True)):
            x = conv(x)
            y = norm(x.features)
            x = x.with_features(y if number == len(self.convs) - 1 else F.relu(y))
        if len(x.sites) == len(fused.sites) and fixed_shapes() is None:  # only the current cells: keep their maps
            return fused.with_features(fused.features + x.features)
        sites = Sites.from_linear(x.sites.linear(), (fused.batch_size, *self.grid.cells))
        if fixed_shapes() is not None:
            spread = gather_rows(fused.features, places_among(fused.sites, sites))
        else:
            rows = sites.nearest_rows(fused.sites.keys)
            spread = fused.features.new_zeros(x.features.shape).index_copy(0, rows, fused.features)
        return SparseBEV(sites, spread + x.features)

    def _over_time(self, fused: SparseBEV, warped: WarpedCells | None) -> SparseMap:
        """The current and the remembered cells with an embedding of their age."""
        b, cell = fused.batch_size, fused.indices
        now = torch.full_like(cell[:, :1], self.config.num_frames)
        indices = torch.cat([cell[:, :1], now, cell[:, 1:]], dim=1)
        # All cells of a slot have one age: embed it once per (sample, slot) and look it up; unused slots hold 0.
        ages, features = self.time.mlp[0].bias.new_zeros(b * self.num_slots), fused.features
        if warped is not None:
            ages[warped.indices[:, 0] * self.num_slots + warped.indices[:, 1]] = warped.elapsed_s
            indices = torch.cat([warped.indices, indices])
            features = torch.cat([warped.features.to(features.dtype), features])
        sites, owners = Sites.unique(indices, self.shape(b))
        times = F.embedding(indices[:, 0] * self.num_slots + indices[:, 1], self.time(ages))
        features = torch.cat([features, times.to(features.dtype)], dim=1)
        return SparseMap(sites, segment_mean(features, owners, len(sites)))

    def _over_time_padded(self, fused: SparseBEV, warped: PaddedWarpedCells) -> SparseMap:
        """As `_over_time`, in fixed shapes."""
        shape = self.shape(fused.batch_size)
        sample, slot, row, col = Sites(shape, warped.keys).strides
        now = fused.sites.positions((sample, row, col), self.config.num_frames * slot)
        sites, owners = Sites.unique_keys(torch.cat([warped.keys, now]), shape)
        num = len(warped.elapsed_s)
        counts = (*[len(warped.keys) // num] * num, len(fused))
        ages = F.pad(warped.elapsed_s, (0, 1))  # the last is that of the current cells
        times = F.embedding(repeat_interleave(counts, ages.device), self.time(ages))
        features = torch.cat([warped.features.to(fused.features.dtype), fused.features])
        features = torch.cat([features, times.to(features.dtype)], dim=1)
        return SparseMap(sites, segment_mean(features, owners, len(sites), sites.groups))


def _cell_head(channels: int, outputs: int) -> nn.ModuleList:
    """Submanifold 3x3, norm, ReLU, then one linear layer per cell."""
    hidden = channels // 2
    conv = SubmanifoldConv(channels, hidden, 3, 2, bias=False)
    return nn.ModuleList([ConvNormReLU(conv, **NORM), FullPrecisionLinear(hidden, outputs)])
