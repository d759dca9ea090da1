"""Pinhole projection and the image augmentation's 3x3 (method 1.1 and 9). Pixel centres lie at +0.5."""

from __future__ import annotations

import math

import numpy as np

Array = np.ndarray


def image_transform(
    resize: float,  # augmented pixels per source pixel
    offset_px: tuple[float, float],  # (x, y) of the crop's corner in the resized image; negative = padding
    size_px: tuple[int, int],  # (height, width) of the crop
    flip: bool = False,
    rotation_rad: float = 0.0,  # from the x axis towards the y axis (down), about the crop's centre
) -> Array:  # [3, 3] float64, augmented pixels from source pixels
    """M_n of method 9: resize, crop, mirror left-right, rotate."""
    height, width = size_px
    matrix = np.array([[resize, 0.0, -offset_px[0]], [0.0, resize, -offset_px[1]], [0.0, 0.0, 1.0]])
    if flip:
        matrix = np.array([[-1.0, 0.0, width], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) @ matrix
    if rotation_rad:
        c, s, x, y = math.cos(rotation_rad), math.sin(rotation_rad), 0.5 * width, 0.5 * height
        matrix = np.array([[c, -s, x - c * x + s * y], [s, c, y - s * x - c * y], [0.0, 0.0, 1.0]]) @ matrix
    return matrix


def pixels_from_points(
    intrinsics: Array,  # [..., 3, 3] K
    cam_from_src: Array,  # [..., 4, 4] x right, y down, z forward
    pix_from_image: Array | None = None,  # [..., 3, 3] M_n, augmented pixels from source pixels
) -> Array:  # [..., 4, 4] float64: (u*d, v*d, d, 1) = P (x, y, z, 1)
    """P_n = M_n K_n E of method 1.1 over the row (0, 0, 0, 1), hence invertible."""
    projection = intrinsics if pix_from_image is None else pix_from_image @ intrinsics
    result = np.array(np.broadcast_to(np.asarray(cam_from_src, np.float64), cam_from_src.shape))
    result[..., :3, :] = projection @ cam_from_src[..., :3, :]
    return result
