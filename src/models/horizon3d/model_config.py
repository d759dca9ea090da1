"""Settings of Horizon3D: its parts, and which of them go together."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import ClassVar, Self

from src.errors import ConfigError
from src.models.backbones.sparse_voxel import RadarEncoderConfig
from src.models.detector import ModelConfig
from src.models.heads.center_head import HeadConfig
from src.models.horizon3d.dptf import DPTFConfig
from src.models.horizon3d.kggi import KGGIConfig
from src.models.horizon3d.loss import Horizon3DLossConfig
from src.models.horizon3d.ocsf import OCSFConfig
from src.models.layers.doppler import DopplerConfig
from src.models.layers.feed_forward import NUM_HEADS

CHANNEL_MULTIPLE = 4 * NUM_HEADS
"""C splits into attention heads of at least 4 channels and into groups of 4 for the camera head's norm."""


@dataclass(kw_only=True)
class Horizon3DConfig(ModelConfig):
    """Settings of the model (`model`). Raises ConfigError for parts that do not go together."""

    temporal_part: ClassVar[str] = "dptf"
    temporal_switches: ClassVar[tuple[str, ...]] = ("doppler.cells",)
    new_in_temporal_phase: ClassVar[str] = r"dptf\.|ocsf\.encoder\.layers\.\d+\.temporal_attention\."
    layer_stack: ClassVar[str] = "ocsf.encoder.layers"

    radar_encoder: RadarEncoderConfig
    kggi: KGGIConfig | None  # null together with ocsf: radar only
    ocsf: OCSFConfig | None
    dptf: DPTFConfig | None  # null: single frames, phase 1
    doppler: DopplerConfig
    neck_channels: list[int]  # of a sparse neck before the head, at strides 2, 4, ...; []: none
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
        if min(self.neck_channels, default=1) < 1:
            raise ConfigError(f"model.neck_channels={self.neck_channels}: must list positive widths, or nothing")
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
    def moves_memory(self) -> bool:
        """Whether any path compensates for velocities."""
        paths = [self.dptf.bev_path, self.dptf.gaussian_path] if self.dptf is not None else []
        return any(path is not None and path.velocity_compensation for path in paths)

    @property
    def keys_of_temporal_phase(self) -> tuple[str, ...]:
        """All of DPTF with its loss terms; velocities of Gaussians unless they are supervised before."""
        terms = [f"cell_{term}_weight" for term in ("focal", "dice", "lovasz", "velocity")]
        if not self.loss.gaussian_velocity_in_phase1:
            terms += ["dptf_weight", "gaussian_velocity_weight"]
        switches = (f"model.{switch}" for switch in self.temporal_switches)
        return ("model.dptf", *switches, *(f"model.loss.{term}" for term in terms))

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
                count = getattr(settings.kggi, key)
                setattr(settings.kggi, key, count and max(1, round(gaussians * count)))
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
