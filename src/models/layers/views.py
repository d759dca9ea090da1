"""Image features with their cameras: projecting the plane into the views and lifting pixels out of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from src.geometry.constants import where_scalar
from src.geometry.tensor_transforms import invert_projection
from src.ops.score_and_lift_pixels import lift_pixel_centres
from src.ops.view_samples import MIN_DEPTH_M
from src.structures.batch import FrameBatch
from src.structures.taxonomy import CAMERAS


@dataclass
class CameraViews:
    """Pyramid of N views for each of B samples, with calibration; geometry is float32 even under autocast.

    Pixels are those of the augmented network input, pixel centres at +0.5.
    """

    levels: list[Tensor]  # L x [B, N, C_I, h, w], finest first
    pix_from_aug: Tensor  # [B, N, 4, 4]: (x, y, z, 1) in aug metres -> (u*d, v*d, d, 1)
    valid: Tensor  # [B, N] bool, False where the camera is missing
    image_size_px: tuple[int, int]  # (H, W)

    @classmethod
    def encode(
        cls,
        encoder: Callable[[Tensor], list[Tensor]],  # images to pyramid
        batch: FrameBatch,
    ) -> CameraViews:
        """The images of a batch. Raises ValueError where it has none, or another number of views."""
        if batch.images is None or batch.image_valid is None or batch.pix_from_aug is None:
            raise ValueError("FrameBatch.images is None, but this model uses images; read them with the frames")
        if batch.images.shape[1] != len(CAMERAS):
            raise ValueError(f"FrameBatch.images must hold {len(CAMERAS)} views, but got {batch.images.shape[1]}")
        height, width = batch.images.shape[-2:]
        return cls(encoder(batch.images), batch.pix_from_aug, batch.image_valid, (int(height), int(width)))

    @property
    def finest_stride_px(self) -> int:
        """Pixels of the input per cell of the finest level."""
        return self.image_size_px[0] // self.levels[0].shape[-2]

    @property
    def aug_from_pix(self) -> Tensor:  # [B, N, 4, 4]: (u*d, v*d, d, 1) -> (x, y, z, 1)
        """The way back, the identity for a missing camera."""
        with torch.autocast(self.pix_from_aug.device.type, enabled=False):
            return invert_projection(self.pix_from_aug, self.valid)

    def project(
        self,
        points: Tensor,  # [B, Q, P, 3] aug metres
    ) -> tuple[Tensor, Tensor]:  # [B, Q, N, P, 2] pixels (u, v), [B, Q, N, P] bool
        """Pixels of the points in every view and whether they are visible there; invisible ones get pixel (0, 0)."""
        with torch.autocast(points.device.type, enabled=False):
            matrix = self.pix_from_aug.float()[:, :, :3]  # [B, N, 3, 4]
            homogeneous = torch.einsum("bnij,bqpj->bqnpi", matrix[..., :3], points.float())
            homogeneous = homogeneous + matrix[:, None, :, None, :, 3]  # [B, Q, N, P, 3]
            depth = homogeneous[..., 2]
            pixels = homogeneous[..., :2] / depth.clamp(min=MIN_DEPTH_M)[..., None]
            height, width = self.image_size_px
            inside = (pixels >= 0).all(-1) & (pixels[..., 0] < width) & (pixels[..., 1] < height)
            visible = inside & (depth > MIN_DEPTH_M) & self.valid[:, None, :, None]
            return where_scalar(visible[..., None], pixels, 0.0), visible

    def lift(
        self,
        depth: Tensor,  # [B, N, h, w] m along the optical axis, one per pixel of the finest level
    ) -> Tensor:  # [B, N, h, w, 3] aug metres
        """3D points at the pixel centres of the finest level, without gradient."""
        with torch.no_grad():
            return lift_pixel_centres(depth, self.aug_from_pix, self.image_size_px)

    def lift_pixels(
        self,
        points: Tensor,  # [B, Q, N, 3] (u * d, v * d, d)
    ) -> Tensor:  # [B, Q, N, 3] aug metres
        """3D points at any pixels, without gradient; those of a missing camera are finite."""
        with torch.no_grad(), torch.autocast(points.device.type, enabled=False):
            aug_from_pix = self.aug_from_pix[:, None, :, :3]  # [B, 1, N, 3, 4]
            return (aug_from_pix[..., :3] @ points.float()[..., None]).squeeze(-1) + aug_from_pix[..., 3]
