"""KGGI, keypoint-guided Gaussian initialisation: where the Gaussians start (Sec. 3.1)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import torch
from torch import Tensor, nn

from src.errors import ConfigError, require_least
from src.geometry.bev_grid import BEVGrid
from src.models.heads.keypoint_head import KEYPOINT_BIAS, CameraKeypointHead, CameraMaps, lift_keypoints
from src.models.horizon3d.gaussian_encoder import RAW_ATTRIBUTES, GaussianBounds
from src.models.layers.full_precision import FullPrecisionLinear
from src.models.layers.views import CameraViews
from src.ops.gather_cells import gather_cells
from src.ops.initial_gaussians import Attributes, Keypoints, Slots, initial_gaussians
from src.ops.nms import maxpool_peaks
from src.ops.segment_reduce import topk_per_sample
from src.structures.gaussians import GaussianSet
from src.structures.sparse_bev import SparseBEV
from src.structures.taxonomy import Source
from src.targets.depth import DepthBinsConfig, DepthTarget, lid_centres

INSIDE = 1.0 - 1e-5
"""Random means stay strictly inside the grid, in units of its half extent."""


class Initialization(Enum):
    """Where Gaussians come from (Table 3)."""

    both = "both"
    keypoint = "keypoint"
    random = "random"


@dataclass(kw_only=True)
class KGGIConfig(DepthBinsConfig):
    """Settings of KGGI (`model.kggi`). Raises ConfigError for values that cannot work on any grid."""

    initialization: Initialization  # Table 3
    num_radar_keypoints: int  # K_r
    num_camera_keypoints: int  # K_c
    num_random_keypoints: int  # K_rand; with initialization=random all three counts are random Gaussians
    num_radar_peaks: int  # so many of the radar keypoints are maxima of 3 x 3 cells, before the best of all others
    depth_target: DepthTarget  # what supervises the depth head
    keypoint_nms_cells: int | None  # odd window of local maxima in the keypoint map; null = every pixel competes
    property_head: bool  # local features correct the learnable attributes
    source_embedding_std: float  # of the source embedding's random start

    def __post_init__(self) -> None:
        least = 0 if self.initialization is Initialization.random else 1
        own = {"num_radar_keypoints": least, "num_camera_keypoints": least}
        own |= {"num_radar_peaks": 0, "source_embedding_std": 0}
        require_least(self, "model.kggi", own)
        if self.num_random_keypoints < 0 or sum(self.counts.values()) < 1:
            raise ConfigError(
                f"model.kggi.num_random_keypoints={self.num_random_keypoints}: must not be negative, and "
                "the three sources together must give at least one Gaussian"
            )
        if self.num_radar_peaks > self.num_radar_keypoints:
            raise ConfigError(
                f"model.kggi.num_radar_peaks={self.num_radar_peaks}: must not exceed "
                f"model.kggi.num_radar_keypoints={self.num_radar_keypoints}, of which they are a part"
            )
        self.check_depth_bins("model.kggi")
        window = self.keypoint_nms_cells
        if window is not None and (window < 3 or window % 2 == 0):
            raise ConfigError(f"model.kggi.keypoint_nms_cells={window}: must be null or an odd number from 3 on")

    @property
    def uses_keypoints(self) -> bool:
        """Whether keypoint heads exist; without them there is no KGGI loss."""
        return self.initialization is not Initialization.random

    @property
    def counts(self) -> dict[Source, int]:
        """Gaussians per source, sources without any left out."""
        radar, camera, random = self.num_radar_keypoints, self.num_camera_keypoints, self.num_random_keypoints
        if self.initialization is Initialization.random:
            radar, camera, random = 0, 0, radar + camera + random
        elif self.initialization is Initialization.keypoint:
            random = 0
        counts = {Source.RADAR: radar, Source.CAMERA: camera, Source.RANDOM: random}
        return {source: count for source, count in counts.items() if count}


def with_peaks_first(
    logits: Tensor,  # [M] of cells
    bev: SparseBEV,
    count: int,
) -> Tensor:  # [M]
    """Scores in the order of the logits, but for the `count` best maxima of 3 x 3 cells of each sample, which lead."""
    scores = logits.sigmoid()
    peaks = maxpool_peaks(scores[:, None], bev.sites).squeeze(1)
    best = topk_per_sample(scores + peaks, bev.indices[:, 0], bev.batch_size, count).flatten()
    lead = scores.new_zeros(len(scores) + 1).index_fill(0, best.remainder(len(scores) + 1), 1.0)  # -1: the row too many
    return scores + lead[:-1]


@dataclass
class KGGIOutput:
    """G_0 and what the KGGI losses need."""

    gaussians: GaussianSet
    objectness_logits: Tensor | None  # [M] per cell of the radar map, None without keypoint heads
    camera: CameraMaps | None


class GaussianSlots(nn.Module):
    """Learnable attributes and features of the K Gaussians of one source, by their rank."""

    def __init__(self, count: int, channels: int) -> None:
        super().__init__()
        self.attributes = nn.Parameter(torch.tensor(RAW_ATTRIBUTES).repeat(count, 1))  # [K, 7]
        self.features = nn.Parameter(torch.empty(count, channels))
        nn.init.xavier_uniform_(self.features)


class KGGI(nn.Module):
    """Gaussians at radar keypoints, at lifted camera keypoints and at learnable positions (method 4)."""

    def __init__(
        self, config: KGGIConfig, channels: int, image_channels: int, grid: BEVGrid, bounds: GaussianBounds
    ) -> None:
        super().__init__()
        if config.num_radar_keypoints > grid.rows * grid.cols and config.uses_keypoints:
            raise ConfigError(
                f"model.kggi.num_radar_keypoints={config.num_radar_keypoints}: must not exceed the "
                f"{grid.rows * grid.cols} cells of grid.cells={list(grid.cells)}"
            )
        self.config, self.grid, self.bounds = config, grid, bounds
        counts = config.counts
        self.slots = nn.ModuleDict({source.name.lower(): GaussianSlots(n, channels) for source, n in counts.items()})
        self.source_embedding = nn.Embedding(len(Source), channels)
        nn.init.normal_(self.source_embedding.weight, std=config.source_embedding_std)
        if Source.RANDOM in counts:
            # In units of the half extent, so that one step of Adam is of the order of a metre.
            self.random_means = nn.Parameter(torch.empty(counts[Source.RANDOM], 2).uniform_(-1.0, 1.0))
        if config.uses_keypoints:
            self.objectness = nn.Sequential(
                nn.Linear(channels, channels // 2), nn.ReLU(), FullPrecisionLinear(channels // 2, 1)
            )
            nn.init.constant_(self.objectness[-1].bias, KEYPOINT_BIAS)
            self.camera_head = CameraKeypointHead(image_channels, channels, config.num_depth_bins)
            centres = lid_centres(config.depth_range, config.num_depth_bins)
            self.register_buffer("depth_centres_m", centres, persistent=False)
        if config.uses_keypoints and config.property_head:
            self.property_heads = nn.ModuleDict(
                {name: FullPrecisionLinear(channels, channels + len(RAW_ATTRIBUTES)) for name in ("radar", "camera")}
            )
            for head in self.property_heads.values():
                nn.init.zeros_(head.weight)
                nn.init.zeros_(head.bias)
        self.register_buffer("centre_m", torch.tensor(grid.centre_m), persistent=False)
        self.register_buffer("half_extent_m", torch.tensor(grid.half_extent_m), persistent=False)

    def merge_for_inference(self) -> None:
        """What the Gaussians of all sources start with is computed once."""
        counts, embedding = self.config.counts, self.source_embedding.weight
        values = [
            torch.cat([slots.features + embedding[source], slots.attributes], dim=1)
            for source, slots in zip(counts, self.slots.values(), strict=True)
        ]
        sources = [torch.full((count,), int(source), device=embedding.device) for source, count in counts.items()]
        means = self._learnt_means() if Source.RANDOM in counts else self.centre_m.new_zeros(0, 2)
        self.register_buffer("slot_values", torch.cat(values), persistent=False)
        self.register_buffer("slot_sources", torch.cat(sources), persistent=False)
        self.register_buffer("slot_means", means, persistent=False)
        self.slots = self.random_means = None

    def forward(self, radar_bev: SparseBEV, views: CameraViews, history: GaussianSet | None = None) -> KGGIOutput:
        """G_0: radar, camera, random, then history Gaussians with their own attributes and features (method 4.4)."""
        found: list[tuple[Source, Tensor, Tensor, Tensor]] = []
        logits = camera = None
        if self.config.uses_keypoints:
            logits = self.objectness(radar_bev.features).squeeze(-1)  # [M]
            camera = self.camera_head(views.levels[0])
            found.append((Source.RADAR, *self._radar_keypoints(logits.detach(), radar_bev)))
            found.append((Source.CAMERA, *self._camera_keypoints(camera, views)))
        if self.slots is None:
            return KGGIOutput(self._merged(found, history, radar_bev.batch_size), logits, camera)
        parts = [self._gaussians(*one) for one in found]
        if Source.RANDOM in self.config.counts:
            means = self._learnt_means().expand(radar_bev.batch_size, -1, -1)
            valid = torch.ones(means.shape[:2], dtype=torch.bool, device=means.device)
            parts.append(self._gaussians(Source.RANDOM, means, valid, None))
        if history is not None:
            parts.append(replace(history, features=history.features + self.source_embedding.weight[Source.HISTORY]))
        return KGGIOutput(GaussianSet.concatenate(parts, dim=1), logits, camera)

    def _learnt_means(self) -> Tensor:  # [K, 2] m
        means = self.random_means
        beyond = means.detach() - means.detach().clamp(-INSIDE, INSIDE)
        return self.centre_m + self.half_extent_m * (means - beyond)  # the gradient passes, so that they can come back

    def _radar_keypoints(
        self,
        scores: Tensor,  # [M]
        radar_bev: SparseBEV,
    ) -> tuple[Tensor, Tensor, Tensor]:  # [B, K, 2] m, [B, K] bool, [B, K, C]
        if self.config.num_radar_peaks:
            scores = with_peaks_first(scores, radar_bev, self.config.num_radar_peaks)
        rows = topk_per_sample(scores, radar_bev.indices[:, 0], radar_bev.batch_size, self.config.num_radar_keypoints)
        return gather_cells(radar_bev.features, radar_bev.indices, rows, self.grid)

    def _camera_keypoints(
        self, camera: CameraMaps, views: CameraViews
    ) -> tuple[Tensor, Tensor, Tensor]:  # [B, K, 2] m, [B, K] bool, [B, K, C]
        wanted, window = self.config.num_camera_keypoints, self.config.keypoint_nms_cells
        points, valid, local = lift_keypoints(camera, views, self.depth_centres_m, self.grid, wanted, window)
        return points[..., :2], valid, local

    def _merged(
        self, found: list[tuple[Source, Tensor, Tensor, Tensor]], history: GaussianSet | None, batch_size: int
    ) -> GaussianSet:
        """All Gaussians at once."""
        shift = self.source_embedding.weight[Source.HISTORY]
        slots = Slots(self.slot_values, self.slot_sources, self.slot_means, shift)
        keypoints = [
            Keypoints(means, valid, self._change(source.name.lower(), local)) for source, means, valid, local in found
        ]
        past = None if history is None else Attributes(**{name: getattr(history, name) for name in Attributes._fields})
        made = initial_gaussians(slots, keypoints, past, self.centre_m, self.bounds, batch_size)
        return GaussianSet(**made._asdict())

    def _change(
        self,
        name: str,
        local: Tensor | None,  # [B, K, C] features at the keypoints
    ) -> Tensor | None:  # [B, K, C + 7]
        """What the property head changes, where there is one."""
        return None if local is None or not self.config.property_head else self.property_heads[name](local)

    def _gaussians(
        self,
        source: Source,
        means: Tensor,  # [B, K, 2] m
        valid: Tensor,  # [B, K] bool
        local: Tensor | None,  # [B, K, C] features at the keypoints
    ) -> GaussianSet:
        """Slot attributes, corrected by the property head where there is one."""
        name = source.name.lower()
        features = self.slots[name].features + self.source_embedding.weight[source]  # [K, C]
        features, raw = features.expand(*valid.shape, -1), self.slots[name].attributes.expand(*valid.shape, -1)
        change = self._change(name, local)
        if change is not None:
            features, raw = features + change[..., : features.shape[-1]], raw + change[..., features.shape[-1] :]
        return GaussianSet(
            means=torch.where(valid[..., None], means.float(), self.centre_m),
            features=features,
            sources=torch.full_like(valid, int(source), dtype=torch.int64),
            elapsed_s=torch.zeros_like(valid, dtype=torch.float32),
            valid=valid,
            **self.bounds.activate(raw),
        )
