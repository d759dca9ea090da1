"""Transforms of torch tensors: rigid inverses, points and vectors, the way back from pixels; `transforms` is numpy's.

Vectors are turned component by component: autocast and TF32 would round the factors of a matrix product,
and with them positions of 150 m.
"""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor
from torch.autograd.function import FunctionCtx, once_differentiable

from src.geometry.constants import constant

IDENTITY = tuple(tuple(float(row == column) for column in range(4)) for row in range(4))


def invert_rigid(
    dst_from_src: Tensor,  # [..., 4, 4] rotation and translation
) -> Tensor:  # [..., 4, 4] src_from_dst
    """Inverse of rigid transforms, without a general solve."""
    rotation = dst_from_src[..., :3, :3].transpose(-1, -2)
    inverse = torch.zeros_like(dst_from_src)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3] = -(rotation @ dst_from_src[..., :3, 3:]).squeeze(-1)
    inverse[..., 3, 3] = 1.0
    return inverse


def rotate(
    cosine: Tensor,
    sine: Tensor,
    along: Tensor,
    across: Tensor,
) -> tuple[Tensor, Tensor]:  # x and y; all shapes broadcast
    """R(theta) (along, across): from a heading's own axes to those of the frame."""
    return cosine * along - sine * across, sine * along + cosine * across


def unit_vectors(
    vectors: Tensor,  # [..., d]
    eps: float,
) -> Tensor:  # [..., d]
    """v / max(|v|, eps), as torch's `normalize`, with half the launches backward: (g - u (u g)) / |v|."""
    return _UnitVectors.apply(vectors, eps)


class _UnitVectors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: FunctionCtx, vectors: Tensor, eps: float) -> Tensor:
        norm = torch.linalg.vector_norm(vectors, dim=-1, keepdim=True)
        length = norm.clamp(min=eps)
        unit = vectors / length
        ctx.save_for_backward(unit, norm, length)
        return unit

    @staticmethod
    @once_differentiable
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor, None]:
        unit, norm, length = ctx.saved_tensors
        along = (grad * unit).sum(-1, keepdim=True) * (norm == length)  # a vector below eps is only scaled
        return torch.addcmul(grad, unit, along, value=-1) / length, None


def rotate_back(
    cosine: Tensor,
    sine: Tensor,
    x: Tensor,
    y: Tensor,
) -> tuple[Tensor, Tensor]:  # along and across; all shapes broadcast
    """R(theta)^T (x, y): the components along a heading and across it, to its left."""
    return cosine * x + sine * y, cosine * y - sine * x


def transform_vectors_xy(
    dst_from_src: Tensor,  # [..., 4, 4]
    vectors: Tensor,  # [..., 2]
) -> Tensor:  # [..., 2]
    """Vectors of the plane z = 0, such as velocities, in another frame."""
    return dst_from_src[..., :2, 0] * vectors[..., :1] + dst_from_src[..., :2, 1] * vectors[..., 1:]


def transform_points_xy(
    dst_from_src: Tensor,  # [..., 4, 4]
    points: Tensor,  # [..., 2] m
) -> Tensor:  # [..., 2] m
    """Points of the plane z = 0 in another frame."""
    return transform_vectors_xy(dst_from_src, points) + dst_from_src[..., :2, 3]


@cache  # as `constant`
def pixel_centres(
    image_size_px: tuple[int, int],  # (H, W) of the network input
    level_size: tuple[int, int],  # (h, w) of a feature level
    device: torch.device,
) -> Tensor:  # [h, w, 3] (u, v, 1), pixels of the input
    """Where the cells of a feature level have their centres in the image."""
    (height, width), (h, w) = image_size_px, level_size
    with torch.inference_mode(False):
        v = (torch.arange(h, device=device) + 0.5) * (height / h)
        u = (torch.arange(w, device=device) + 0.5) * (width / w)
        v, u = torch.meshgrid(v, u, indexing="ij")
        return torch.stack([u, v, torch.ones_like(u)], -1)


def invert_projection(
    pix_from_src: Tensor,  # [B, N, 4, 4]: (x, y, z, 1) -> (u*d, v*d, d, 1)
    valid: Tensor,  # [B, N] bool, False where the camera is missing
) -> Tensor:  # [B, N, 4, 4] float32: (u*d, v*d, d, 1) -> (x, y, z, 1)
    """Inverse of the cameras' projections, computed in float64; the identity for a missing camera.

    A missing camera may carry any matrix: its points are never used, but must not stop the inversion.
    """
    identity = constant(IDENTITY, pix_from_src.dtype, pix_from_src.device)
    matrix = torch.where(valid[..., None, None], pix_from_src, identity)
    return torch.linalg.inv_ex(matrix.double())[0].float()


def transform_points(
    dst_from_src: Tensor,  # [..., 4, 4]
    points: Tensor,  # [..., 3] m
) -> Tensor:  # [..., 3] m
    """Points in another frame."""
    return transform_vectors(dst_from_src, points) + dst_from_src[..., :3, 3]


def transform_vectors(
    dst_from_src: Tensor,  # [..., 4, 4]
    vectors: Tensor,  # [..., 3]
) -> Tensor:  # [..., 3]
    """Vectors, such as velocities, in another frame."""
    x, y, z = (dst_from_src[..., :3, axis] * vectors[..., axis : axis + 1] for axis in range(3))
    return x + y + z
