"""Memory of whole BEV maps: past maps warped by ego motion, fused with the current one (BEVDet4D; method 13)."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.geometry.bev_grid import BEVGrid
from src.geometry.tensor_transforms import transform_points_xy
from src.models.layers.dense import DenseConvNormReLU, MapConv2d
from src.models.layers.norm import MapBatchNorm
from src.models.memory import FrameMemory, Motion, RememberedFrame, TemporalConfig
from src.ops.concat_conv import concat_conv2d
from src.structures.batch import FrameBatch

STORED = torch.bfloat16
"""Type of remembered maps: half the memory, and 0.4 % is far below what normalised features resolve."""


@dataclass
class MapFrame(RememberedFrame):
    """The fused map of one key frame of each of B streams, detached.

    Its cells lie in the frame's own augmented ego frame, to which `aug_from_ego` leads from the ego frame: a map is
    resampled once, from there to the current frame.
    """

    aug_from_ego: Tensor  # [B, 4, 4] float32, A of its own time
    cells: Tensor  # [B, rows, cols, C] bfloat16


@dataclass(frozen=True)
class MapMemory(FrameMemory[MapFrame]):
    """The last maps of each of B streams, newest first."""

    frame_type = MapFrame


@dataclass
class RecalledMaps:
    """Past maps and their motion to the current augmented frame, newest first; `TemporalFusion.maps` resamples them."""

    frames: tuple[MapFrame, ...]  # of the batch's past (`FrameMemory.before`), at most as many as configured
    motions: list[Motion]
    usable: Tensor  # [frames of the configuration, B] bool


class TemporalFusion(nn.Module):
    """Past maps, aligned by ego motion and concatenated with the current one, change it by two convolutions.

    Moving objects stay where they were: their motion is left to the convolutions, as in BEVDet4D.
    """

    norm_pairs = (("refine", "norm"),)

    def __init__(self, config: TemporalConfig, channels: int, grid: BEVGrid) -> None:
        super().__init__()
        self.config, self.grid = config, grid
        self.reduce = DenseConvNormReLU((config.num_frames + 1) * channels, channels, 1)
        self.refine = MapConv2d(channels, channels, 3, padding=1, bias=False)
        self.norm = MapBatchNorm(channels)
        nn.init.zeros_(self.norm.weight)  # untrained, the memory adds exactly zero
        row, col = torch.meshgrid(torch.arange(grid.rows), torch.arange(grid.cols), indexing="ij")
        self.register_buffer("centres_m", grid.centre_of(torch.stack([row, col], -1)), persistent=False)

    def forward(
        self,
        memory: MapMemory | None,
        batch: FrameBatch,
        fused: Tensor,  # [B, C, rows, cols]
    ) -> tuple[Tensor, RecalledMaps, MapMemory]:
        """The current map changed by the past, what of the past is in use, and the memory with the current map."""
        recalled = self.recall(memory, batch)
        return self.aggregate(fused, recalled), recalled, self.remember(recalled.frames, batch, fused)

    @torch.no_grad()
    def recall(self, memory: MapMemory | None, batch: FrameBatch) -> RecalledMaps:
        """The remembered maps with their motion to the batch's time and augmented frame."""
        frames = memory.before(batch).frames[: self.config.num_frames] if memory is not None else ()
        motions = [frame.motion(batch, self.config.max_age_s) for frame in frames]
        usable = torch.zeros(self.config.num_frames, len(batch), dtype=torch.bool, device=batch.device)
        for age, motion in enumerate(motions):
            usable[age] = motion.usable
        return RecalledMaps(frames, motions, usable)

    def maps(self, recalled: RecalledMaps) -> Iterator[Tensor]:  # of [B, C, rows, cols] float32
        """Past maps resampled into the current augmented frame, newest first; zero where nothing is known."""
        for frame, motion in zip(recalled.frames, recalled.motions, strict=True):
            yield self.align(frame, motion.aug_from_past, motion.usable)

    @torch.no_grad()
    def align(
        self,
        frame: MapFrame,
        aug_from_past: Tensor,  # [B, 4, 4] float32, from the ego frame of the past
        usable: Tensor,  # [B] bool
    ) -> Tensor:  # [B, C, rows, cols] float32, channels last
        """The map in the current frame: bilinear samples where the current cells were then, zero outside."""
        with torch.autocast(aug_from_past.device.type, enabled=False):
            past_from_aug = torch.linalg.inv_ex(aug_from_past.double())[0]
            then_from_now = (frame.aug_from_ego.double() @ past_from_aug).float()  # augmented frame to augmented frame
            xy = transform_points_xy(then_from_now[:, None, None], self.centres_m)
            size = xy.new_tensor([self.grid.cols, self.grid.rows])
            samples = self.grid.to_cells(xy) * (2 / size) - 1  # [B, rows, cols, 2], edges of the map at -1 and 1
            maps = frame.cells.permute(0, 3, 1, 2).float()
            aligned = F.grid_sample(maps, samples, mode="bilinear", padding_mode="zeros", align_corners=False)
            return torch.where(usable[:, None, None, None], aligned, 0.0)

    def aggregate(
        self,
        fused: Tensor,  # [B, C, rows, cols]
        recalled: RecalledMaps,
    ) -> Tensor:  # [B, C, rows, cols]
        """F + norm(refine(reduce([F, M_1, ..., M_T]))): the current map F, changed by the warped past maps M."""
        maps = itertools.chain([fused], self.maps(recalled))  # younger clips remember fewer, the others are zero
        x = concat_conv2d(maps, self.reduce.conv.weight, self.reduce.conv.bias)  # of torch.cat(maps, dim=1)
        return fused + self.norm(self.refine(F.relu(self.reduce.norm(x))))

    @torch.no_grad()
    def remember(
        self,
        past: tuple[MapFrame, ...],  # of `RecalledMaps`
        batch: FrameBatch,
        fused: Tensor,  # [B, C, rows, cols]
    ) -> MapMemory:
        """The past with the current map added."""
        frame = MapFrame(
            batch.timestamps_s,
            batch.global_from_ego,
            torch.ones_like(batch.timestamps_s, dtype=torch.bool),
            batch.aug_from_ego,
            fused.detach().permute(0, 2, 3, 1).to(STORED).contiguous(),
        )
        return MapMemory((frame, *past)[: self.config.num_frames])
