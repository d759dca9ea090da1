"""What travels from the data layer to a model: one key frame of each of B samples."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import torch
from torch import Tensor

from src.structures.boxes import Boxes3D

MAX_EGO_SPEED_MPS = 100.0
"""Poses further apart than this speed allows are a jump of the localisation, not a drive."""
RADAR_POINT_FIELDS = ("x", "y", "z", "rcs", "vx", "vy", "dt")


@dataclass
class FrameBatch:
    """B key frames with their sensors, calibration and, where known, annotations.

    Frames: `ego` is the vehicle at the LIDAR_LEFT key frame, `aug` the same after BEV augmentation A_t (spec 9).
    Global coordinates are float64; only ego-relative ones are float32. Images are raw RGB bytes: each model
    normalises as its backbone was trained.

    Raises ValueError when shapes, types or indices disagree.
    """

    tokens: list[str]  # B sample tokens
    timestamps_s: Tensor  # [B] float64
    global_from_ego: Tensor  # [B, 4, 4] float64
    aug_from_ego: Tensor  # [B, 4, 4] float32, A_t; identity at test time
    radar_points: Tensor  # [P, 7] float32: x, y, z (m, aug), rcs (dB), vx, vy (m/s compensated, aug axes), dt (s)
    radar_batch: Tensor  # [P] int64, sample of each point, ascending
    images: Tensor | None = None  # [B, N, 3, H, W] uint8 RGB
    image_valid: Tensor | None = None  # [B, N] bool, False where a camera is missing
    pix_from_aug: Tensor | None = None  # [B, N, 4, 4] float32: P_n over (0, 0, 0, 1); (u*d, v*d, d, 1) = P (x, y, z, 1)
    boxes: list[Boxes3D] | None = None  # B, aug frame
    streams: Tensor | None = (
        None  # [B] int64, unique: the stream of frames that each row is the next of; None: unordered
    )
    starts: Tensor | None = (
        None  # [B] bool, the row begins a clip: memory of its stream ends here; given with `streams`
    )
    skipped: dict[str, int] = field(default_factory=dict)  # unreadable files passed over, by channel
    bad_files: list[str] = field(default_factory=list)  # which these were, relative to the data set's root

    def __post_init__(self) -> None:
        b = len(self.tokens)
        self._expect("timestamps_s", (b,), torch.float64)
        self._expect("global_from_ego", (b, 4, 4), torch.float64)
        self._expect("aug_from_ego", (b, 4, 4), torch.float32)
        self._expect("radar_points", (self.radar_points.shape[0], len(RADAR_POINT_FIELDS)), torch.float32)
        self._expect("radar_batch", (self.radar_points.shape[0],), torch.int64)
        owners = self.radar_batch
        # Values are looked at where the batch is built; on a GPU the look would stall every step.
        looked_at = owners.device.type == "cpu" and len(owners) > 0
        if looked_at and not (owners[0] >= 0 and owners[-1] < b and bool((owners.diff() >= 0).all())):
            raise ValueError(f"FrameBatch.radar_batch must ascend within 0..{b - 1}")
        if self.images is not None:
            n, _, h, w = self.images.shape[1:]
            self._expect("images", (b, n, 3, h, w), torch.uint8)
            self._expect("image_valid", (b, n), torch.bool)
            self._expect("pix_from_aug", (b, n, 4, 4), torch.float32)
        if (self.streams is None) != (self.starts is None):
            raise ValueError("FrameBatch.streams and FrameBatch.starts must be given together")
        if self.streams is not None:
            self._expect("streams", (b,), torch.int64)
            self._expect("starts", (b,), torch.bool)
            if self.streams.device.type == "cpu" and len(set(self.streams.tolist())) != b:
                raise ValueError(f"FrameBatch.streams must be unique, but got {self.streams.tolist()}")
        if self.boxes is not None and len(self.boxes) != b:
            raise ValueError(f"FrameBatch.boxes must hold {b} entries, one per sample, but got {len(self.boxes)}")

    def _expect(self, name: str, shape: tuple[int, ...], dtype: torch.dtype) -> None:
        value = getattr(self, name)
        if value is None or tuple(value.shape) != shape or value.dtype != dtype:
            found = "None" if value is None else f"{list(value.shape)} {value.dtype}"
            raise ValueError(f"FrameBatch.{name} must be {list(shape)} {dtype}, but got {found}")

    def __len__(self) -> int:
        return len(self.tokens)

    @property
    def device(self) -> torch.device:
        """Where the tensors lie."""
        return self.radar_points.device

    def _map(self, function: object) -> FrameBatch:
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        for name, value in values.items():
            if isinstance(value, Tensor):
                values[name] = function(value)
        if self.boxes is not None:
            values["boxes"] = [function(boxes) for boxes in self.boxes]
        return FrameBatch(**values)

    def to(self, device: torch.device | str, non_blocking: bool = False) -> FrameBatch:
        """The same batch on another device."""
        return self._map(lambda value: value.to(device, non_blocking=non_blocking))

    def pin_memory(self) -> FrameBatch:
        """The same batch in page-locked memory, for the loader's transfer to a GPU."""
        return self._map(lambda value: value.pin_memory())
