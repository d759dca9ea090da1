"""Horizon3D: encode, recall, initialise Gaussians, fuse through them, aggregate over time, detect (Fig. 2)."""

from __future__ import annotations

from torch import Tensor

from src.errors import ConfigError
from src.geometry.bev_grid import BEVGrid
from src.models.backbones.image import ImageEncoder, ImageEncoderConfig
from src.models.backbones.sparse_voxel import RadarEncoder
from src.models.detector import Detector, Objective
from src.models.heads.center_head import BoxOptions, CenterHead, HeadOutput
from src.models.horizon3d.dptf import DPTF, WarpedMemory
from src.models.horizon3d.dptf_memory import DPTFMemory
from src.models.horizon3d.fixed_form import FixedHorizon3D
from src.models.horizon3d.kggi import KGGI
from src.models.horizon3d.loss import cell_losses, gaussian_velocity_loss, kggi_losses, ocsf_losses
from src.models.horizon3d.model_config import Horizon3DConfig
from src.models.horizon3d.ocsf import OCSF
from src.models.horizon3d.output import Horizon3DOutput
from src.models.horizon3d.sparse_neck import SparseNeck
from src.models.layers.doppler import Doppler
from src.models.layers.views import CameraViews
from src.ops.fixed_shapes import Capacities
from src.ops.side_stream import on_side_stream
from src.structures.batch import FrameBatch
from src.structures.evidence import Evidence
from src.structures.sparse_bev import SparseBEV
from src.structures.taxonomy import CAMERAS
from src.targets.box_raster import BoxRaster


class Horizon3D(Detector):
    """Sparse radar-camera detector whose views meet in a set of 2D Gaussians on the BEV plane.

    `backbone` is only read when the model uses images. Raises ConfigError when parts, grid and backbone do not fit.
    """

    phase_options = BoxOptions
    memory_type = DPTFMemory
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
        "detection_head": ("neck.forward", "head.forward", "head.decode"),
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
        self.neck = SparseNeck(channels, config.neck_channels) if config.neck_channels else None
        self.head = CenterHead(config.head, channels, grid, options.velocity_code_weight)

    def forward(self, batch: FrameBatch, memory: DPTFMemory | None = None) -> tuple[Horizon3DOutput, DPTFMemory | None]:
        """Detect in the frames of B streams, given what is remembered of them; the new memory is detached.

        Raises ValueError when images are needed and absent, or when the memory is of another number of streams.
        """
        if memory is not None:
            memory.check_streams(batch)
        if self.dptf is None:
            return self.detect(batch, None), None
        warped_memory = self.dptf.recall(memory, batch)
        output = self.detect(batch, warped_memory)
        return output, self.dptf.remember(warped_memory.past, batch, output.fused_bev, output.dptf, output.ocsf)

    def detect(self, batch: FrameBatch, warped_memory: WarpedMemory | None) -> Horizon3DOutput:
        """What `forward` makes of a batch and of the memory brought to its time; None for single frames."""
        views = kggi = ocsf = None
        with on_side_stream(batch.device) as join_images:
            if self.image_encoder is not None:
                views = CameraViews.encode(self.image_encoder, batch)
        radar_bev = fused = self.radar_encoder(batch.radar_points, batch.radar_batch, len(batch))
        doppler = self._measure_doppler(batch)
        join_images()
        if views is not None:
            kggi = self.kggi(radar_bev, views, warped_memory.history if warped_memory is not None else None)
            ocsf = self.ocsf(kggi.gaussians, radar_bev, views, doppler["gaussians"])
            fused = ocsf.fused_bev
        if self.dptf is None:
            return Horizon3DOutput(radar_bev, views, kggi, ocsf, fused, None, self._read_map(fused, doppler["boxes"]))
        dptf = self.dptf.aggregate(fused, warped_memory, doppler["cells"])
        return Horizon3DOutput(radar_bev, views, kggi, ocsf, fused, dptf, self._read_map(dptf.bev, doppler["boxes"]))

    def _read_map(self, bev: SparseBEV, doppler: Doppler | None) -> HeadOutput:
        return self.head(bev if self.neck is None else self.neck(bev), doppler)

    def _measure_doppler(self, batch: FrameBatch) -> dict[str, Doppler | None]:
        """Measured velocities for `gaussians`, `cells` and `boxes`; None for each that `model.doppler` leaves out."""
        config, measured = self.config.doppler, None
        wanted = {name: getattr(config, name) for name in ("gaussians", "cells", "boxes")}
        if any(wanted.values()):
            points, owners = batch.radar_points, batch.radar_batch
            measured = Doppler.measure(points, owners, self.grid, config)
        return {name: measured if its else None for name, its in wanted.items()}

    def fixed_form(self, capacities: Capacities | None = None) -> FixedHorizon3D | None:
        """See `Detector.fixed_form`."""
        return FixedHorizon3D(self, capacities) if FixedHorizon3D.serves(self) else None

    def loss_terms(self, output: Horizon3DOutput, batch: FrameBatch) -> Objective:
        """Terms of Eq. 10 as weighted."""
        config, boxes, weights = self.config, batch.boxes, self.config.loss
        terms, counts = self.head.loss(output.head, boxes, weights.heatmap_weight, weights.box_weight)
        margin_m = config.ocsf.margin_m if config.ocsf is not None else 0.0
        raster = BoxRaster(boxes, self.grid, margin_m, batch.device)
        if output.kggi is not None and output.ocsf is not None:
            terms |= kggi_losses(output.kggi, output.radar_bev, output.views, raster, config.kggi, weights)
            terms |= ocsf_losses(output.ocsf, raster, weights)
            if config.dptf is not None or weights.gaussian_velocity_in_phase1:
                terms |= gaussian_velocity_loss(output.ocsf, raster, weights)
        if output.dptf is not None and output.dptf.cells is not None:
            terms |= cell_losses(output.dptf.cells, output.fused_bev, raster, weights)
        return Objective(terms, counts)

    def evidence(self, output: Horizon3DOutput) -> Evidence:
        """Refined Gaussians, the cells of their splat, and the warped memory."""
        return output.evidence(self.config, self.grid)

    def diagnostics(self, output: Horizon3DOutput) -> dict[str, Tensor | float]:
        """What is occupied and remembered; see `Horizon3DOutput.diagnostics`."""
        return output.diagnostics(self.config, self.grid)
