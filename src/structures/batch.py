"""What travels from the data layer to a model: one frame of each of B samples."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from src.structures.boxes import Boxes3D
from src.structures.ray_bundle import RayBundle
from src.structures.tensor_fields import TensorFields

MAX_EGO_SPEED_MPS = 100.0
"""Poses further apart than this speed allows are a jump of the localisation, not a drive."""
RADAR_POINT_FIELDS = ("x", "y", "z", "rcs", "vx", "vy", "dt")
LIDAR_POINT_FIELDS = ("x", "y", "z", "intensity", "dt")


@dataclass
class FrameBatch(TensorFields):
    """B key frames with the sensors that were read, calibration and, where known, annotations.

    Frames: `ego` is the vehicle at the LIDAR_LEFT key frame, `aug` the same after BEV augmentation A_t (method 9).
    Global coordinates are float64; only ego-relative ones are float32. Images are raw RGB bytes: each model
    normalises as its backbone was trained. A sensor that was not read is None; one without returns has no points. `dt`
    is the key frame's time less the point's, above 0 for older points.

    Raises ValueError when shapes, types or indices disagree.
    """

    tokens: list[str]  # B sample tokens
    timestamps_s: Tensor  # [B] float64
    global_from_ego: Tensor  # [B, 4, 4] float64
    aug_from_ego: Tensor  # [B, 4, 4] float32, A_t; identity at test time
    radar_points: Tensor | None = None  # [P, 7] float32: x, y, z (m, aug), rcs (dB), vx, vy (m/s over ground), dt (s)
    radar_batch: Tensor | None = None  # [P] int64, sample of each point, ascending
    lidar_points: Tensor | None = None  # [L, 5] float32: x, y, z (m, aug), intensity as stored, dt (s)
    lidar_batch: Tensor | None = None  # [L] int64, sample of each point, ascending
    lidar_origins: Tensor | None = None  # [L, 3] float32 m, aug: where the sensor was when it measured the point
    lidar_speeds: Tensor | None = None  # [L] float32 m/s over ground along the point's ray, away > 0; NaN where unknown
    images: Tensor | None = None  # [B, N, 3, H, W] uint8 RGB
    image_valid: Tensor | None = None  # [B, N] bool, False where a camera is missing
    pix_from_aug: Tensor | None = None  # [B, N, 4, 4] float32: P_n over (0, 0, 0, 1); (u*d, v*d, d, 1) = P (x, y, z, 1)
    boxes: list[Boxes3D] | None = None  # B, aug frame, on the host
    streams: Tensor | None = None  # [B] int64, unique: the stream that each row is the next frame of; None: unordered
    starts: Tensor | None = None  # [B] bool, the row begins a clip: memory of its stream ends; given with `streams`
    skipped: dict[str, int] = field(default_factory=dict)  # unreadable files skipped, by channel
    bad_files: list[str] = field(default_factory=list)  # which these were, relative to the data set's root
    rays: RayBundle | None = None
    """LiDAR at several times of the same scenes: supervision, never an input. None where it was not asked for."""
    past: tuple[FrameBatch, ...] = ()
    """Frames before these, the oldest first, with the A_t of this batch, for a memory made in this step alone.

    Where a scene had not begun, the row repeats this frame's token, time and pose and sees nothing.
    """

    def __post_init__(self) -> None:
        b = len(self.tokens)
        self._expect("timestamps_s", (b,), torch.float64)
        self._expect("global_from_ego", (b, 4, 4), torch.float64)
        self._expect("aug_from_ego", (b, 4, 4), torch.float32)
        self._check_points("radar", len(RADAR_POINT_FIELDS))
        self._check_points("lidar", len(LIDAR_POINT_FIELDS))
        if self.lidar_speeds is not None:
            self._expect("lidar_speeds", (0 if self.lidar_points is None else len(self.lidar_points),), torch.float32)
            if self.lidar_origins is None:
                raise ValueError("FrameBatch.lidar_origins must be given with lidar_speeds, which are along the rays")
        if self.lidar_origins is not None:
            self._expect(
                "lidar_origins", (0 if self.lidar_points is None else len(self.lidar_points), 3), torch.float32
            )
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
        sizes = [len(frame) for frame in self.past]
        if sizes != [b] * len(sizes):
            raise ValueError(f"FrameBatch.past must hold batches of {b}, but got {sizes}")
        if self.rays is not None:
            self._check_owners("rays.batch", self.rays.batch)

    def _check_points(self, sensor: str, width: int) -> None:
        points, owners = getattr(self, f"{sensor}_points"), getattr(self, f"{sensor}_batch")
        if points is None and owners is None:
            return
        count = 0 if points is None else len(points)
        self._expect(f"{sensor}_points", (count, width), torch.float32)
        self._expect(f"{sensor}_batch", (count,), torch.int64)
        self._check_owners(f"{sensor}_batch", owners)

    def _check_owners(self, name: str, owners: Tensor) -> None:
        # Values are looked at where the batch is built; on a GPU the look would stall every step.
        looked_at = owners.device.type == "cpu" and len(owners) > 0
        if looked_at and not (owners[0] >= 0 and owners[-1] < len(self) and bool((owners.diff() >= 0).all())):
            raise ValueError(f"FrameBatch.{name} must ascend within 0..{len(self) - 1}")

    def _expect(self, name: str, shape: tuple[int, ...], dtype: torch.dtype) -> None:
        value = getattr(self, name)
        if value is None or tuple(value.shape) != shape or value.dtype != dtype:
            found = "None" if value is None else f"{list(value.shape)} {value.dtype}"
            raise ValueError(f"FrameBatch.{name} must be {list(shape)} {dtype}, but got {found}")

    def __len__(self) -> int:
        return len(self.tokens)

    def to(self, device: torch.device | str, non_blocking: bool = False) -> FrameBatch:
        """The batch on another device, but for the annotations: targets begin on the host, which waits for no sizes."""
        past = tuple(frame.to(device, non_blocking) for frame in self.past)
        moved = super(FrameBatch, replace(self, boxes=None, past=())).to(device, non_blocking)
        return replace(moved, boxes=self.boxes, past=past)

    @property
    def device(self) -> torch.device:
        """Where the tensors lie."""
        return self.timestamps_s.device

    @property
    def ego_from_aug(self) -> Tensor:  # [B, 4, 4] float32
        """The inverse of A_t."""
        return torch.linalg.inv_ex(self.aug_from_ego).inverse
