"""DPTF, dual-path temporal fusion: a memory of BEV cells and one of Gaussians (Sec. 3.3; method 6)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.errors import ConfigError, require_least
from src.geometry.bev_grid import BEVGrid
from src.models.horizon3d.bev_path import BEVPath, BEVPathConfig, CellPrediction, PaddedWarpedCells, WarpedCells
from src.models.horizon3d.dptf_memory import DPTFFrame, DPTFMemory
from src.models.horizon3d.gaussian_path import GaussianPath, GaussianPathConfig, VelocityFrom
from src.models.horizon3d.ocsf import OCSFOutput
from src.models.layers.doppler import Doppler
from src.ops.sites import rows_of_keys
from src.structures.batch import FrameBatch
from src.structures.evidence import WarpedPoints
from src.structures.gaussians import GaussianSet
from src.structures.sparse_bev import SparseBEV


@dataclass(kw_only=True)
class DPTFConfig:
    """Settings of the temporal part (`model.dptf`). Raises ConfigError when there is nothing to remember."""

    max_age_s: float  # older memory is not used
    min_speed_mps: float  # what is slower is moved by the ego motion alone
    bev_path: BEVPathConfig | None
    gaussian_path: GaussianPathConfig | None

    def __post_init__(self) -> None:
        if not self.max_age_s > 0:
            raise ConfigError(f"model.dptf.max_age_s={self.max_age_s}: must be positive")
        require_least(self, "model.dptf", {"min_speed_mps": 0})
        if self.bev_path is None and self.gaussian_path is None:
            raise ConfigError(
                "model.dptf.bev_path=null and model.dptf.gaussian_path=null leave nothing to remember; use "
                "model.dptf=null for a model without memory"
            )
        if self.bev_path is None and self.gaussian_path.velocity_from is VelocityFrom.cells:
            raise ConfigError(
                "model.dptf.gaussian_path.velocity_from=cells, but model.dptf.bev_path=null predicts no velocities of "
                "cells; use velocity_from=gaussian"
            )

    @property
    def num_frames(self) -> int:
        """How many past key frames are remembered at most."""
        return max(path.num_frames for path in (self.bev_path, self.gaussian_path) if path is not None)


@dataclass
class WarpedMemory:
    """The memory warped into the current frame."""

    past: DPTFMemory  # less what is not in the frame's past (`DPTFMemory.before`)
    history: GaussianSet | None  # None: nothing remembered, or the path is off
    warped: WarpedCells | PaddedWarpedCells | None


@dataclass
class DPTFOutput:
    """What the losses, the head and pictures read."""

    history: GaussianSet | None
    warped: WarpedCells | PaddedWarpedCells | None
    cells: CellPrediction | None  # on the cells of F_fuse; None without the BEV path
    bev: SparseBEV  # F_out


class DPTF(nn.Module):
    """Both memory paths; a path that is off costs nothing."""

    def __init__(self, config: DPTFConfig, channels: int, grid: BEVGrid) -> None:
        super().__init__()
        self.config = config
        self.bev_path = BEVPath(config.bev_path, channels, grid) if config.bev_path is not None else None
        self.gaussian_path = (
            GaussianPath(config.gaussian_path, channels, grid) if config.gaussian_path is not None else None
        )

    def recall(self, memory: DPTFMemory | None, batch: FrameBatch) -> WarpedMemory:
        """Bring the memory to the batch's time and frame."""
        history = warped = None
        limits = (self.config.max_age_s, self.config.min_speed_mps)
        memory = DPTFMemory(()) if memory is None else memory.before(batch)
        if self.gaussian_path is not None:
            history = self.gaussian_path.recall(memory, batch, *limits)
        if self.bev_path is not None:
            warped = self.bev_path.recall(memory, batch, *limits)
        return WarpedMemory(memory, history, warped)

    def aggregate(self, fused: SparseBEV, warped_memory: WarpedMemory, doppler: Doppler | None = None) -> DPTFOutput:
        """F_fuse and the remembered cells into F_out."""
        cells, bev = None, fused
        if self.bev_path is not None:
            cells = self.bev_path.predict(fused, doppler)
            bev = self.bev_path.aggregate(fused, warped_memory.warped)
        return DPTFOutput(warped_memory.history, warped_memory.warped, cells, bev)

    def remember(
        self,
        past: DPTFMemory,  # of the batch, see `WarpedMemory`
        batch: FrameBatch,
        fused: SparseBEV,
        output: DPTFOutput,
        ocsf: OCSFOutput | None,  # None for radar only, which has no Gaussians
    ) -> DPTFMemory:
        """The memory with the current frame added."""
        cells = gaussians = None
        if self.bev_path is not None:
            cells = self.bev_path.store(fused, output.cells, batch)
        if self.gaussian_path is not None:
            found, active = self.candidates(fused, output, ocsf)
            gaussians = self.gaussian_path.store(found, active, batch)
            if self.config.gaussian_path.forget_refuted and output.history is not None:
                past = self.gaussian_path.without_refuted(past, output.history, active)
        frame = DPTFFrame(
            batch.timestamps_s,
            batch.global_from_ego,
            torch.ones_like(batch.timestamps_s, dtype=torch.bool),
            cells,
            gaussians,
        )
        paths = (self.config.bev_path, self.config.gaussian_path)
        return past.push(frame, *(path.num_frames if path is not None else 0 for path in paths))

    def candidates(
        self, fused: SparseBEV, output: DPTFOutput, ocsf: OCSFOutput
    ) -> tuple[GaussianSet, Tensor]:  # G_L, [B, G] bool
        """The Gaussians of a frame as they are remembered, and which of them are active."""
        active = ocsf.splat.active(self.config.gaussian_path.min_contribution)
        gaussians = ocsf.gaussians
        if self.config.gaussian_path.velocity_from is VelocityFrom.cells:
            gaussians = _with_cell_velocities(gaussians, ocsf.splat.peak_cells, fused, output.cells)
        return gaussians, active


def _with_cell_velocities(
    gaussians: GaussianSet,
    peak_cells: Tensor,  # [B, G] int64 linear keys, -1 for none
    fused: SparseBEV,
    cells: CellPrediction,
) -> GaussianSet:
    """Each Gaussian with the velocity of the cell where it contributes most, whose target it shares (Eq. 9)."""
    rows = rows_of_keys(fused.sites.linear(), peak_cells)
    found = F.pad(cells.velocities, (0, 0, 0, 1))[rows]  # row -1, none, is the last: there may be no cell at all
    return replace(gaussians, velocities=torch.where(rows[..., None] >= 0, found, gaussians.velocities))


def warped_evidence(config: DPTFConfig, output: DPTFOutput) -> dict[str, WarpedPoints | None]:
    """`warped_gaussians` and `warped_cells` of the first sample for pictures, None for a path that is off."""
    gaussians = cells = None
    if config.gaussian_path is not None:
        found = output.history if output.history is not None else GaussianSet.empty()
        keep = found.valid[0]
        columns = (found.means[0][keep], found.velocities[0][keep], found.elapsed_s[0][keep])
        gaussians = WarpedPoints(*columns, config.gaussian_path.velocity_compensation, found)
    if config.bev_path is not None:
        nothing, warped = torch.zeros(0, 2), output.warped
        columns = (nothing, nothing, nothing[:, 0])
        if warped is not None:
            own = warped.indices[:, 0] == 0
            columns = (warped.xy[own], warped.velocities[own], warped.elapsed_s[own])
        cells = WarpedPoints(*columns, config.bev_path.velocity_compensation)
    return {"warped_gaussians": gaussians, "warped_cells": cells}
