"""What the volume says at any place and time: occupancy and radial velocity, with the offset branch (lrs 5.7)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.errors import ConfigError, require_least
from src.geometry.voxel_grid import VoxelGrid
from src.losses.normalizers import full_precision
from src.models.lrs4fusion.late_encoder import FUSED_SCALE, NUM_SCALES, Volumes
from src.ops.ball_query import OFFSETS, ball_query

HORIZON_S = 3.0
"""Times are divided by it."""
QUERY_FEATURES = 4


@dataclass(kw_only=True)
class DecoderConfig:
    """Settings of the decoders (`model.decoders`). Raises ConfigError for values that cannot work."""

    hidden_channels: int
    num_blocks: int
    neighbours: list[int]  # voxels that a point sees in V1 .. V4: 1, its own, or 7, with those at its faces
    velocity: bool  # a decoder of radial velocity, where there is something to supervise it
    velocity_unit_mps: float  # in which the network states it

    def __post_init__(self) -> None:
        require_least(self, "model.decoders", {"hidden_channels": 1, "num_blocks": 1})
        if not self.velocity_unit_mps > 0:
            raise ConfigError(f"model.decoders.velocity_unit_mps={self.velocity_unit_mps}: must be above 0")
        if len(self.neighbours) != NUM_SCALES or not set(self.neighbours) <= {1, len(OFFSETS)}:
            raise ConfigError(
                f"model.decoders.neighbours={self.neighbours}: must list 1 or {len(OFFSETS)} for each of the "
                f"{NUM_SCALES} scales"
            )


class Decoders(nn.Module):
    """One sampler, and a head each for occupancy and velocity.

    Queries [Q, 4] are x, y, z in m (aug frame of the volumes) and t in s from their time, `batch` [Q] int64 their
    samples. A place outside the region sees no volume and gets what a head says to its position and time alone.
    Everything runs in float32 also under autocast: positions, times and velocities are what is read and written.
    """

    full_precision_parts = ("",)

    def __init__(
        self,
        config: DecoderConfig,
        channels: Sequence[int],  # of V1 .. V4
        grid: VoxelGrid,
    ) -> None:
        super().__init__()
        hidden = config.hidden_channels
        self.sampler = QuerySampler(hidden, config.neighbours, channels, grid)
        width = self.sampler.out_channels
        self.occupancy = QueryHead(width, hidden, config.num_blocks)
        self.velocity = QueryHead(width, hidden, config.num_blocks) if config.velocity else None
        self.velocity_unit_mps = config.velocity_unit_mps
        if self.velocity is not None:
            nn.init.zeros_(self.velocity.output.weight)  # untrained, everything rests or goes as measured
            nn.init.zeros_(self.velocity.output.bias)

    @property
    def at_rest(self) -> bool:
        """Whether the velocity decoder adds 0 to what is measured: so it begins, and stays without known speeds."""
        return not any(parameter.any() for parameter in self.velocity.output.parameters())

    def forward(self, volumes: Volumes, queries: Tensor, batch: Tensor) -> tuple[Tensor, Tensor | None]:  # [Q], [Q]
        """What both heads say, the second None where there is none, from one look into the volumes."""
        place, seen, measured = self.sampler(volumes, queries, batch)
        return self.occupancy(place, seen), None if self.velocity is None else self._speeds(place, seen, measured)

    def occupancy_logits(self, volumes: Volumes, queries: Tensor, batch: Tensor) -> Tensor:  # [Q]
        """Logits of the probability that a place is occupied."""
        place, seen, _ = self.sampler(volumes, queries, batch)
        return self.occupancy(place, seen)

    def velocities(self, volumes: Volumes, queries: Tensor, batch: Tensor) -> Tensor:  # [Q] m/s
        """Radial velocities, away from the ego positive, over ground: what stands has 0 however the ego moves (O14).

        Raises ConfigError where there is no decoder of them.
        """
        if self.velocity is None:
            raise ConfigError("model.decoders.velocity=false: this model predicts no velocities")
        return self._speeds(*self.sampler(volumes, queries, batch))

    def _speeds(self, place: Tensor, seen: Tensor, measured: Tensor) -> Tensor:  # [Q] m/s
        return measured + self.velocity_unit_mps * self.velocity(place, seen)


class QuerySampler(nn.Module):
    """Features at a place p and where the offset branch looks instead: z = [V2(p), V1(p'), V2(p'), V3(p'), V4(p')].

    p' = p + dp(p, t, V2(p)): for another time than now, dp learns to lead to where the matter of (p, t) is now. It
    begins at zero. With measured motion V2(p) is that of the voxels as they will lie at t, and p' = p - v t + dp where
    one that moves by v is met; at p' all scales are those of now.
    """

    def __init__(self, hidden: int, neighbours: Sequence[int], channels: Sequence[int], grid: VoxelGrid) -> None:
        super().__init__()
        self.neighbours, self.grid = tuple(neighbours), grid
        self.out_channels = channels[FUSED_SCALE] + sum(channels)
        self.place, self.context = nn.Linear(QUERY_FEATURES, hidden), nn.Linear(channels[FUSED_SCALE], hidden)
        self.hidden = nn.ModuleList(nn.Linear(hidden, hidden) for _ in range(2))
        self.offset = nn.Linear(hidden, 3)
        nn.init.zeros_(self.offset.weight)
        nn.init.zeros_(self.offset.bias)

    def forward(
        self,
        volumes: Volumes,
        queries: Tensor,  # [Q, 4] x, y, z m, t s
        batch: Tensor,  # [Q] int64
    ) -> tuple[Tensor, Tensor, Tensor]:  # [Q, 4], [Q, out_channels], [Q] m/s
        """Normalised place and time, the features z, and the radial speed measured of what is at p', 0 for rest."""
        with torch.autocast(queries.device.type, enabled=False):
            points, times = full_precision(queries).split([3, 1], dim=1)
            place = torch.cat([self.grid.normalised(points), times / HORIZON_S], dim=1)
            if volumes.measured is None:
                here, start = self._seen(volumes, FUSED_SCALE, points, batch), points
                measured = torch.zeros_like(points[:, 0])
            else:
                near = self.neighbours[FUSED_SCALE]
                here, start, measured = volumes.measured.seen_at(points, times.squeeze(1), batch, near)
            a = self.place(place) + self.context(here)
            for layer in self.hidden:
                a = F.relu(layer(a))
            source = start + self.offset(a)
            there = [self._seen(volumes, scale, source, batch) for scale in range(NUM_SCALES)]
            return place, torch.cat([here, *there], dim=1), measured

    def _seen(self, volumes: Volumes, scale: int, points: Tensor, batch: Tensor) -> Tensor:  # [Q, C]
        volume = volumes.scales[scale]
        grid, neighbours = self.grid.at(scale), self.neighbours[scale]
        return ball_query(full_precision(volume.features), volume.sites, grid, points, batch, neighbours)


class QueryHead(nn.Module):
    """One number per query: h = L(q), then h += L_b(z), h += MLP_b(h) for every block b, then L(h)."""

    def __init__(self, channels: int, hidden: int, num_blocks: int) -> None:
        super().__init__()
        self.place = nn.Linear(QUERY_FEATURES, hidden)
        self.seen = nn.ModuleList(nn.Linear(channels, hidden) for _ in range(num_blocks))
        self.blocks = nn.ModuleList(
            nn.Sequential(nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, hidden))
            for _ in range(num_blocks)
        )
        self.output = nn.Linear(hidden, 1)

    def forward(
        self,
        place: Tensor,  # [Q, 4]
        seen: Tensor,  # [Q, C]
    ) -> Tensor:  # [Q]
        with torch.autocast(place.device.type, enabled=False):
            h = self.place(place)
            for layer, block in zip(self.seen, self.blocks, strict=True):
                h = h + layer(seen)
                h = h + block(h)
            return self.output(h).squeeze(1)
