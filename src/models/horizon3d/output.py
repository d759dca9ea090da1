"""What Horizon3D makes of one batch, and what pictures and curves show of it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.models.heads.center_head import HeadOutput
from src.models.horizon3d.dptf import DPTFOutput, warped_evidence
from src.models.horizon3d.kggi import KGGIOutput
from src.models.horizon3d.model_config import Horizon3DConfig
from src.models.horizon3d.ocsf import OCSFOutput
from src.models.layers.views import CameraViews
from src.structures.evidence import Evidence, HeadCells, SplattedCells
from src.structures.sparse_bev import SparseBEV


@dataclass
class Horizon3DOutput:
    """One frame through the model; the Gaussian parts are None for radar only, DPTF for single frames."""

    radar_bev: SparseBEV  # F_R
    views: CameraViews | None
    kggi: KGGIOutput | None  # G_0 and the keypoint maps
    ocsf: OCSFOutput | None  # G_L, its splat and F_fuse
    fused_bev: SparseBEV  # F_fuse, or F_R where there is nothing to fuse
    dptf: DPTFOutput | None  # warped memory and F_out; None in phase 1
    head: HeadOutput

    @property
    def head_bev(self) -> SparseBEV:
        """F_out, in phase 1 F_fuse."""
        return self.fused_bev if self.dptf is None else self.dptf.bev

    def evidence(self, config: Horizon3DConfig, grid: BEVGrid) -> Evidence:
        """Refined Gaussians, the cells of their splat and of the head, and the warped memory."""
        evidence = Evidence(head_cells=HeadCells(grid, self.head_bev.indices))
        if self.ocsf is not None:
            cells = self.ocsf.splat.cells
            sample, cell = cells.support // (grid.rows * grid.cols), cells.support % (grid.rows * grid.cols)
            indices = torch.stack([sample, cell // grid.cols, cell % grid.cols], dim=1)
            occupied = torch.zeros_like(sample, dtype=torch.bool).index_fill(0, cells.occupied_rows, True)
            evidence.gaussians = self.ocsf.gaussians
            evidence.cells = SplattedCells(grid, indices, cells.occupancy, occupied)
        if self.dptf is not None:
            evidence = replace(evidence, **warped_evidence(config.dptf, self.dptf))
        return evidence

    def diagnostics(self, config: Horizon3DConfig, grid: BEVGrid) -> dict[str, Tensor | float]:
        """Cells per frame, share of the grid that Gaussians open, cells cut by the guard, Gaussians by source."""
        frames = self.radar_bev.batch_size
        values: dict[str, Tensor | float] = {
            "radar_cells": len(self.radar_bev) / frames,
            "fused_cells": len(self.fused_bev) / frames,
        }
        if self.ocsf is not None:
            splat, gaussians = self.ocsf.splat, self.ocsf.gaussians
            values["occupied_share"] = len(splat.bev) / (frames * grid.rows * grid.cols)
            values["cut_cells"] = splat.cells.num_cut / frames
            for source in config.kggi.counts:
                number = (gaussians.valid & (gaussians.sources == source)).sum()
                values[f"gaussians_{source.name.lower()}"] = number / frames
            opacity = gaussians.opacity_logits.sigmoid() * gaussians.valid
            values["opacity"] = opacity.sum() / gaussians.valid.sum().clamp(min=1)
        if self.dptf is not None:
            if self.dptf.cells is not None:
                kept = self.dptf.cells.occupancy_logits.sigmoid() > config.dptf.bev_path.memory_threshold
                values["remembered_cells"] = kept.sum() / frames
                values["head_cells"] = len(self.head_bev) / frames
            if self.dptf.history is not None:
                values["gaussians_history"] = self.dptf.history.valid.sum() / frames
        return values
