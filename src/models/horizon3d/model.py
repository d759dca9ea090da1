"""Horizon3D: encode, recall, initialise Gaussians, fuse through them, aggregate over time, detect (Fig. 2)."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from src.errors import ConfigError
from src.geometry.bev_grid import BEVGrid
from src.models.backbones.image import ImageEncoder, ImageEncoderConfig
from src.models.backbones.sparse_voxel import RadarEncoder, RadarEncoderConfig
from src.models.detector import Detector, Objective
from src.models.heads.center_head import BoxOptions, CenterHead, HeadConfig, HeadOutput
from src.models.horizon3d.cross_attention import NUM_HEADS
from src.models.horizon3d.dptf import DPTF, DPTFConfig, DPTFOutput, warped_evidence
from src.models.horizon3d.dptf_memory import Memory
from src.models.horizon3d.kggi import KGGI, KGGIConfig, KGGIOutput
from src.models.horizon3d.loss import Horizon3DLossConfig, cell_losses, gaussian_velocity_loss, kggi_losses, ocsf_losses
from src.models.horizon3d.ocsf import OCSF, OCSFConfig, OCSFOutput
from src.models.horizon3d.views import CameraViews
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from src.structures.evidence import Evidence
from src.structures.sparse_bev import SparseBEV
from src.structures.taxonomy import CAMERAS

CHANNEL_MULTIPLE = 4 * NUM_HEADS
"""C splits into attention heads of at least 4 channels and into groups of 4 for the camera head's norm."""


@dataclass(kw_only=True)
class Horizon3DConfig:
    """Settings of the model (`model`). Raises ConfigError for parts that do not go together."""

    temporal_part: ClassVar[str] = "dptf"
    new_in_temporal_phase: ClassVar[str] = r"dptf\.|ocsf\.encoder\.layers\.\d+\.temporal_attention\."

    name: str
    channels: int  # C, width of BEV cells and Gaussians
    radar_encoder: RadarEncoderConfig
    kggi: KGGIConfig | None  # null together with ocsf: radar only
    ocsf: OCSFConfig | None
    dptf: DPTFConfig | None  # null: single frames, phase 1
    head: HeadConfig
    loss: Horizon3DLossConfig

    def __post_init__(self) -> None:
        if (self.kggi is None) != (self.ocsf is None):
            off, on = ("kggi", "ocsf") if self.kggi is None else ("ocsf", "kggi")
            raise ConfigError(
                f"model.{off}=null while model.{on} is set: one makes the Gaussians, the other uses them; set both to "
                "null for radar only, or model.kggi.initialization=random for OCSF without keypoints"
            )
        if self.ocsf is None and self.dptf is not None and self.dptf.gaussian_path is not None:
            raise ConfigError(
                "model.dptf.gaussian_path is set, but model.ocsf=null makes no Gaussians to remember; set "
                "model.dptf.gaussian_path=null as well"
            )
        if self.channels < 1 or self.channels % CHANNEL_MULTIPLE:
            raise ConfigError(
                f"model.channels={self.channels}: must be a positive multiple of {CHANNEL_MULTIPLE}, whole norm groups "
                f"of 4 channels in each of {NUM_HEADS} attention heads"
            )
        if self.temporal_heads is not None and self.channels % self.temporal_heads:
            raise ConfigError(
                f"model.dptf.gaussian_path.self_attention.num_heads={self.temporal_heads}: must divide "
                f"model.channels={self.channels}"
            )

    @property
    def sensors(self) -> tuple[str, ...]:
        """Radar, and cameras where there are Gaussians."""
        return ("radar",) if self.ocsf is None else ("camera", "radar")

    @property
    def keys_of_temporal_phase(self) -> tuple[str, ...]:
        """All of DPTF with its loss terms; velocities of Gaussians unless they are supervised before."""
        terms = [f"cell_{term}_weight" for term in ("focal", "dice", "lovasz", "velocity")]
        if not self.loss.gaussian_velocity_in_phase1:
            terms += ["dptf_weight", "gaussian_velocity_weight"]
        return ("model.dptf", *(f"model.loss.{term}" for term in terms))

    @property
    def memory_frames(self) -> int:
        """How many past key frames are remembered at most; 0 for single frames."""
        return self.dptf.num_frames if self.dptf is not None else 0

    @property
    def memory_max_age_s(self) -> float | None:
        """How far back the memory may lie; None for single frames."""
        return self.dptf.max_age_s if self.dptf is not None else None

    @property
    def temporal_heads(self) -> int | None:
        """Heads of the temporal self-attention, None where it is off."""
        path = self.dptf.gaussian_path if self.dptf is not None else None
        attention = path.self_attention if path is not None else None
        return attention.num_heads if attention is not None else None

    def scaled(
        self, gaussians: float = 1.0, memory_frames: int | None = None, cells_per_frame: int | None = None
    ) -> Self:
        """Keypoints of all kinds, frames of both paths (of Gaussians no more than configured) and their cells."""
        settings = copy.deepcopy(self)
        if settings.kggi is not None and gaussians != 1.0:
            for key in ("num_radar_keypoints", "num_camera_keypoints", "num_random_keypoints"):
                setattr(settings.kggi, key, max(1, round(gaussians * getattr(settings.kggi, key))))
        if memory_frames == 0:
            settings.dptf = None
        cells = settings.dptf.bev_path if settings.dptf is not None else None
        history = settings.dptf.gaussian_path if settings.dptf is not None else None
        if cells is not None and memory_frames is not None:
            cells.num_frames = memory_frames
        if history is not None and memory_frames is not None:
            history.num_frames = min(memory_frames, history.num_frames)
        if cells is not None and cells_per_frame is not None:
            cells.memory_threshold, cells.max_cells_per_frame = 0.0, cells_per_frame
        return settings


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


class Horizon3D(Detector):
    """Sparse radar-camera detector whose views meet in a set of 2D Gaussians on the BEV plane.

    `backbone` is only read when the model uses images. Raises ConfigError when parts, grid and backbone do not fit.
    """

    phase_options = BoxOptions
    benchmark_parts = {
        "ocsf: gaussian encoder": ("ocsf.encoder.forward",),
        "ocsf: splat": ("src.models.horizon3d.ocsf:splat_set",),
        "ocsf: gated fusion": ("ocsf.fusion.forward",),
        "dptf: recall": ("dptf.recall",),
        "dptf: aggregate": ("dptf.aggregate",),
        "dptf: remember": ("dptf.remember",),
    }
    latency_parts = {
        "image_encoder": ("image_encoder.forward",),
        "radar_encoder": ("radar_encoder.forward",),
        "kggi": ("kggi.forward",),
        "ocsf": ("ocsf.forward",),
        "gaussian_encoder": ("ocsf.encoder.forward",),  # within ocsf (Table 14)
        "dptf": ("dptf.recall", "dptf.aggregate", "dptf.remember"),
        "detection_head": ("head.forward", "head.decode"),
    }

    def __init__(
        self,
        config: Horizon3DConfig,
        grid: BEVGrid,
        backbone: ImageEncoderConfig | None,
        options: BoxOptions,
    ) -> None:
        super().__init__()
        self.config, self.grid = config, grid
        channels = config.channels
        self.radar_encoder = RadarEncoder(config.radar_encoder, grid, channels)
        self.image_encoder: ImageEncoder | None = None
        if config.kggi is not None and config.ocsf is not None:
            if backbone is None:
                raise ConfigError("backbone=null: KGGI and OCSF need images; choose a backbone or set both to null")
            self.image_encoder = ImageEncoder(backbone)
            width, levels = self.image_encoder.channels, len(self.image_encoder.strides)
            self.kggi = KGGI(config.kggi, channels, width, grid, config.ocsf.bounds)
            self.ocsf = OCSF(config.ocsf, channels, width, len(CAMERAS), levels, grid, config.temporal_heads)
        self.dptf = DPTF(config.dptf, channels, grid) if config.dptf is not None else None
        self.head = CenterHead(config.head, channels, grid, options.velocity_code_weight)

    @property
    def image_backbone(self) -> nn.Module | None:
        """Backbone without its neck."""
        return None if self.image_encoder is None else self.image_encoder.backbone

    def forward(self, batch: FrameBatch, memory: Memory | None = None) -> tuple[Horizon3DOutput, Memory | None]:
        """Detect in the frames of B streams, given what is remembered of them; the new memory is detached.

        Raises ValueError when images are needed and absent, or when the memory is of another number of streams.
        """
        if memory is not None and memory.frames and memory.batch_size != len(batch):
            raise ValueError(f"the memory holds {memory.batch_size} streams, but the batch {len(batch)} frames")
        warped_memory = self.dptf.recall(memory, batch) if self.dptf is not None else None
        radar_bev = fused = self.radar_encoder(batch.radar_points, batch.radar_batch, len(batch))
        views = kggi = ocsf = None
        if self.image_encoder is not None:
            views = self._encode_views(batch)
            kggi = self.kggi(radar_bev, views, warped_memory.history if warped_memory is not None else None)
            ocsf = self.ocsf(kggi.gaussians, radar_bev, views)
            fused = ocsf.fused_bev
        if self.dptf is None:
            return Horizon3DOutput(radar_bev, views, kggi, ocsf, fused, None, self.head(fused)), None
        dptf = self.dptf.aggregate(fused, warped_memory)
        output = Horizon3DOutput(radar_bev, views, kggi, ocsf, fused, dptf, self.head(dptf.bev))
        return output, self.dptf.remember(warped_memory.past, batch, fused, dptf, ocsf)

    def restore_memory(self, state: list[dict[str, Any]]) -> Memory:
        """The memory that `Memory.state` described."""
        return Memory.from_state(state)

    def _encode_views(self, batch: FrameBatch) -> CameraViews:
        if batch.images is None or batch.image_valid is None or batch.pix_from_aug is None:
            raise ValueError("FrameBatch.images is None, but this model uses images; read them with the frames")
        if batch.images.shape[1] != len(CAMERAS):
            raise ValueError(f"FrameBatch.images must hold {len(CAMERAS)} views, but got {batch.images.shape[1]}")
        height, width = batch.images.shape[-2:]
        return CameraViews(
            self.image_encoder(batch.images), batch.pix_from_aug, batch.image_valid, (int(height), int(width))
        )

    def loss(self, output: Horizon3DOutput, batch: FrameBatch) -> Objective:
        """Terms of Eq. 10 as weighted, and their sum `total`. Raises ValueError for a batch without annotations."""
        if batch.boxes is None:
            raise ValueError("FrameBatch.boxes is None, but a loss needs annotations")
        config = self.config
        with torch.autocast(batch.device.type, enabled=False):
            terms, counts = self.head.loss(output.head, batch.boxes, config.loss.heatmap_weight, config.loss.box_weight)
            if output.kggi is not None and output.ocsf is not None:
                terms |= kggi_losses(
                    output.kggi, output.radar_bev, output.views, batch.boxes, self.grid, config.kggi, config.loss
                )
                terms |= ocsf_losses(output.ocsf, batch.boxes, self.grid, config.ocsf.margin_m, config.loss)
                if config.dptf is not None or config.loss.gaussian_velocity_in_phase1:
                    terms |= gaussian_velocity_loss(
                        output.ocsf, batch.boxes, self.grid, config.ocsf.margin_m, config.loss
                    )
            if output.dptf is not None and output.dptf.cells is not None:
                terms |= cell_losses(output.dptf.cells, output.fused_bev, batch.boxes, self.grid, config.loss)
        zero = torch.zeros((), device=batch.device)
        return Objective(terms | {"total": sum(terms.values(), zero)}, self.diagnostics(output) | counts)

    def decode(self, output: Horizon3DOutput) -> list[Boxes3D]:
        """Boxes of each frame, best first."""
        return self.head.decode(output.head)

    def evidence(self, output: Horizon3DOutput) -> Evidence:
        """Refined Gaussians, the occupied cells of their splat, and the warped memory."""
        evidence = Evidence()
        if output.ocsf is not None:
            cells = output.ocsf.splat.cells
            rows = cells.support % (self.grid.rows * self.grid.cols)
            evidence.gaussians = output.ocsf.gaussians
            evidence.occupied_cells = torch.stack([rows // self.grid.cols, rows % self.grid.cols], dim=1)
            evidence.occupancy = cells.occupancy
        if output.dptf is not None:
            evidence = replace(evidence, **warped_evidence(self.config.dptf, output.dptf))
        return evidence

    @torch.no_grad()
    def diagnostics(self, output: Horizon3DOutput) -> dict[str, Tensor]:
        """Cells per frame, share of the grid that Gaussians open, cells cut by the guard, Gaussians by source."""
        frames = output.radar_bev.batch_size
        values: dict[str, Tensor | float] = {
            "radar_cells": len(output.radar_bev) / frames,
            "fused_cells": len(output.fused_bev) / frames,
        }
        if output.ocsf is not None:
            splat, gaussians = output.ocsf.splat, output.ocsf.gaussians
            values["occupied_share"] = len(splat.bev) / (frames * self.grid.rows * self.grid.cols)
            values["cut_cells"] = splat.cells.num_cut / frames
            for source in self.config.kggi.counts:
                number = (gaussians.valid & (gaussians.sources == source)).sum()
                values[f"gaussians_{source.name.lower()}"] = number / frames
            opacity = gaussians.opacity_logits.sigmoid() * gaussians.valid
            values["opacity"] = opacity.sum() / gaussians.valid.sum().clamp(min=1)
        if output.dptf is not None:
            if output.dptf.cells is not None:
                kept = output.dptf.cells.occupancy_logits.sigmoid() > self.config.dptf.bev_path.memory_threshold
                values["remembered_cells"] = kept.sum() / frames
                values["head_cells"] = len(output.dptf.bev) / frames
            if output.dptf.history is not None:
                values["gaussians_history"] = output.dptf.history.valid.sum() / frames
        device = output.radar_bev.features.device
        return {name: torch.as_tensor(value, dtype=torch.float32, device=device) for name, value in values.items()}
