"""Scores and points of all pixels by one Triton launch (method 4.2)."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.ops.backend import runs_kernels
from src.ops.score_and_lift_pixels import score_and_lift_pixels_reference

PIXELS = 128
"""Pixels of a program, one lane each."""


def score_and_lift_pixels_triton(
    keypoint_logits: Tensor,  # [B, N, h, w]
    depth_logits: Tensor,  # [B, N, D, h, w]
    centres_m: Tensor,  # [D]
    aug_from_pix: Tensor,  # [B, N, 4, 4]
    valid: Tensor,  # [B, N] bool
    image_size_px: tuple[int, int],
    grid: BEVGrid,
    nms_cells: int | None,
) -> tuple[Tensor, Tensor]:
    """The reference's scores and points up to rounding; its own where a window thins them."""
    inputs = (keypoint_logits, depth_logits, centres_m, aug_from_pix)
    if nms_cells is not None or any(x.dtype != torch.float32 for x in inputs) or not runs_kernels(depth_logits):
        return score_and_lift_pixels_reference(*inputs, valid, image_size_px, grid, nms_cells)
    b, n, bins, h, w = depth_logits.shape
    scores, points = depth_logits.new_empty(b, n, h, w), depth_logits.new_empty(b, n, h, w, 3)
    if scores.numel() > 0:
        depth_logits = depth_logits.flatten(0, 1).flatten(2)  # [B * N, D, h * w], a view of images in any format
        matrices = aug_from_pix.flatten(0, 1)
        with torch.cuda.device_of(scores):
            _score[(triton.cdiv(h * w, PIXELS), b * n)](
                *(keypoint_logits.contiguous(), depth_logits, centres_m.contiguous(), matrices),
                *(valid.contiguous().view(torch.uint8), scores, points, bins, h * w, w),
                *(*depth_logits.stride(), *matrices.stride(), image_size_px[0] / h, image_size_px[1] / w),
                *(grid.x_min_m, grid.y_min_m, grid.cell_m, grid.rows, grid.cols),
                BLOCK=PIXELS,
                num_warps=4,
            )
    return scores, points


@triton.jit(do_not_specialize=["bins", "num", "width", "rows", "cols"])
def _score(  # noqa: ANN202
    keypoints, depths, centres, matrices, valid, scores, points, bins, num, width,  # noqa: ANN001
    view_step, bin_step, pixel_step, matrix_step, row_step, col_step,  # noqa: ANN001
    pixel_height, pixel_width, x_min, y_min, cell_m, rows, cols,  # noqa: ANN001
    BLOCK: tl.constexpr,
):  # fmt: skip
    """A block of pixels of one view."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    view = tl.program_id(1).to(tl.int64)
    live = pixel < num
    logits = depths + view * view_step + pixel * pixel_step
    highest = tl.full((BLOCK,), float("-inf"), tl.float32)
    likeliest = tl.zeros((BLOCK,), tl.int32)
    for bin_ in range(0, bins):
        logit = tl.load(logits + bin_ * bin_step, mask=live, other=0.0)
        higher = logit > highest
        highest, likeliest = tl.where(higher, logit, highest), tl.where(higher, bin_, likeliest)
    total = tl.zeros((BLOCK,), tl.float32)
    for bin_ in range(0, bins):
        total += tl.exp(tl.load(logits + bin_ * bin_step, mask=live, other=0.0) - highest)
    confidence = tl.zeros((BLOCK,), tl.float32)
    depth = tl.zeros((BLOCK,), tl.float32)
    for away in tl.static_range(3):
        bin_ = likeliest + away - 1
        inside = live & (bin_ >= 0) & (bin_ < bins)
        share = tl.exp(tl.load(logits + bin_ * bin_step, mask=inside, other=float("-inf")) - highest) / total
        confidence += share
        depth += share * tl.load(centres + bin_, mask=inside, other=0.0)
    depth = depth / confidence
    u = ((pixel % width).to(tl.float32) + 0.5) * pixel_width * depth
    v = ((pixel // width).to(tl.float32) + 0.5) * pixel_height * depth
    score = confidence / (1.0 + tl.exp(-tl.load(keypoints + view * num + pixel, mask=live, other=0.0)))
    there = live & (tl.load(valid + view) > 0)
    for axis in tl.static_range(3):
        row = matrices + view * matrix_step + axis * row_step
        place = tl.load(row) * u + tl.load(row + col_step) * v
        place += tl.load(row + 2 * col_step) * depth + tl.load(row + 3 * col_step)
        tl.store(points + 3 * (view * num + pixel) + axis, place, mask=live)
        if axis == 0:
            cell = tl.div_rn(place - x_min, cell_m)
            there = there & (cell >= 0.0) & (cell < cols)
        if axis == 1:
            cell = tl.div_rn(place - y_min, cell_m)
            there = there & (cell >= 0.0) & (cell < rows)
    tl.store(scores + view * num + pixel, tl.where(there, score, 0.0), mask=live)
