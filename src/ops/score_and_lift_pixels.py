"""How good a keypoint every pixel of some views is, and where it lies (method 4.2), without gradient."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.geometry.constants import constant
from src.geometry.tensor_transforms import pixel_centres
from src.ops.backend import implementation


@torch.no_grad()
def score_and_lift_pixels(
    keypoint_logits: Tensor,  # [B, N, h, w]
    depth_logits: Tensor,  # [B, N, D, h, w]
    centres_m: Tensor,  # [D] of the depth bins
    aug_from_pix: Tensor,  # [B, N, 4, 4]: (u*d, v*d, d, 1) -> (x, y, z, 1)
    valid: Tensor,  # [B, N] bool, False where the camera is missing
    image_size_px: tuple[int, int],  # (H, W)
    grid: BEVGrid,
    nms_cells: int | None,  # pixels below the highest of such a window around them score 0
) -> tuple[Tensor, Tensor]:  # [B, N, h, w], [B, N, h, w, 3] aug metres
    """Probability of a keypoint times confidence in its depth, 0 for what lies outside the grid or in a missing view;
    and the point."""
    inputs = (keypoint_logits, depth_logits, centres_m, aug_from_pix, valid)
    return implementation(score_and_lift_pixels_reference)(*inputs, image_size_px, grid, nms_cells)


def score_and_lift_pixels_reference(
    keypoint_logits: Tensor,
    depth_logits: Tensor,
    centres_m: Tensor,
    aug_from_pix: Tensor,
    valid: Tensor,
    image_size_px: tuple[int, int],
    grid: BEVGrid,
    nms_cells: int | None,
) -> tuple[Tensor, Tensor]:
    """Plain torch form."""
    depth, confidence = most_likely_depth(depth_logits, centres_m)  # [B, N, h, w] each
    points = lift_pixel_centres(depth, aug_from_pix, image_size_px)
    scores = peak_scores(keypoint_logits, nms_cells) * confidence
    return scores * (grid.contains(points[..., :2]) & valid[:, :, None, None]), points


def peak_scores(
    logits: Tensor,  # [B, N, h, w]
    nms_cells: int | None,
) -> Tensor:  # [B, N, h, w] in 0..1
    """S, with everything but the maxima of an nms_cells x nms_cells window set to zero if a window is given."""
    scores = logits.float().sigmoid()
    if nms_cells is None:
        return scores
    peaks = F.max_pool2d(scores, nms_cells, stride=1, padding=nms_cells // 2)
    return scores * (scores == peaks)


def most_likely_depth(
    logits: Tensor,  # [B, N, D, h, w]
    centres_m: Tensor,  # [D]
) -> tuple[Tensor, Tensor]:  # [B, N, h, w] m, [B, N, h, w] in 0..1
    """Mean depth over the most likely bin and its two neighbours, and the probability of the three (method 4.2)."""
    probabilities = logits.float().softmax(2)
    last = len(centres_m) - 1
    window = probabilities.argmax(2, keepdim=True) + constant((-1, 0, 1), torch.int64, logits.device).view(3, 1, 1)
    inside = (window >= 0) & (window <= last)  # [B, N, 3, h, w]
    window = window.clamp(0, last)
    chosen = probabilities.gather(2, window) * inside
    confidence = chosen.sum(2)
    return (chosen * centres_m[window]).sum(2) / confidence, confidence


def lift_pixel_centres(
    depth: Tensor,  # [B, N, h, w] m along the optical axis
    aug_from_pix: Tensor,  # [B, N, 4, 4]
    image_size_px: tuple[int, int],
) -> Tensor:  # [B, N, h, w, 3] aug metres
    """3D points at the centres of all pixels."""
    with torch.autocast(depth.device.type, enabled=False):
        matrix = aug_from_pix[:, :, :3]  # [B, N, 3, 4]
        rays = pixel_centres(image_size_px, depth.shape[-2:], depth.device)  # [h, w, 3]
        points = rays * depth.float()[..., None]  # [B, N, h, w, 3] (u*d, v*d, d)
        lifted = torch.einsum("bnij,bnhwj->bnhwi", matrix[..., :3], points)
        return lifted + matrix[:, :, None, None, :, 3]
