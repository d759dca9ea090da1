"""Places and weights of image attention by a Triton launch each (method 5.3)."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from src.ops.backend import runs_kernels
from src.ops.view_samples import (
    BEYOND,
    MIN_DEPTH_M,
    view_attention_weights_reference,
    view_sampling_locations_reference,
)

POINTS = 256
"""Points of a program, one lane each."""


def view_sampling_locations_triton(
    points: Tensor,  # [B, Q, P, 2]
    heights: Tensor,  # [B, Q, P]
    band_m: tuple[float, float],
    pix_from_aug: Tensor,  # [B, N, 4, 4]
    valid: Tensor,  # [B, N] bool
    image_size_px: tuple[int, int],
) -> tuple[Tensor, Tensor]:  # [B * N, Q, P, 2], [B, Q, N, P] bool
    """The reference's places up to rounding."""
    inputs = (points, heights, pix_from_aug)
    if any(x.dtype != torch.float32 for x in inputs) or not runs_kernels(points):
        return view_sampling_locations_reference(points, heights, band_m, pix_from_aug, valid, image_size_px)
    (b, q, p), n = heights.shape, valid.shape[1]
    places = points.new_empty(b * n, q, p, 2)
    visible = points.new_empty((b, q, n, p), dtype=torch.uint8)
    if places.numel() > 0:
        with torch.cuda.device_of(points):
            _place[(triton.cdiv(b * q * p, POINTS), n)](
                *(points.contiguous(), heights.contiguous(), pix_from_aug.contiguous()),
                *(valid.contiguous().view(torch.uint8), places, visible, b, q, p, n),
                *(band_m[0], band_m[1] - band_m[0], image_size_px[0], image_size_px[1], MIN_DEPTH_M, BEYOND),
                BLOCK=POINTS,
                num_warps=4,
            )
    return places, visible.view(torch.bool)


def view_attention_weights_triton(
    logits: Tensor,  # [B, Q, N * heads * L * P]
    camera: Tensor,  # [B, N, heads * L * P]
    visible: Tensor,  # [B, Q, N, P] bool
    heads: int,
) -> Tensor:  # [B, Q, heads, N, L, P]
    """The reference's weights up to rounding."""
    if logits.dtype != torch.float32 or camera.dtype != torch.float32 or not runs_kernels(logits):
        return view_attention_weights_reference(logits, camera, visible, heads)
    b, q, n, p = visible.shape
    levels = camera.shape[2] // (heads * p)
    out = logits.new_empty(b, q, heads, n, levels, p)
    if out.numel() > 0:
        with torch.cuda.device_of(logits):
            _weigh[(b * q, heads)](
                *(logits.contiguous(), camera.contiguous(), visible.contiguous().view(torch.uint8), out),
                *(q, n, heads, levels, p),
                BLOCK=triton.next_power_of_2(n * levels * p),
                num_warps=1,
            )
    return out


@triton.jit(do_not_specialize=["samples", "queries", "num", "views", "height", "width"])
def _place(  # noqa: ANN202
    points, heights, matrices, valid, places, visible, samples, queries, num, views,  # noqa: ANN001
    low, span, height, width, min_depth, beyond,  # noqa: ANN001
    BLOCK: tl.constexpr,
):  # fmt: skip
    """A block of points in one view."""
    point = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    view = tl.program_id(1)
    live = point < samples * queries * num
    sample = point // (queries * num)
    x = tl.load(points + 2 * point, mask=live, other=0.0)
    y = tl.load(points + 2 * point + 1, mask=live, other=0.0)
    z = low + span / (1.0 + tl.exp(-tl.load(heights + point, mask=live, other=0.0)))
    row = matrices + (sample * views + view) * 16
    u = tl.load(row, mask=live, other=0.0) * x + tl.load(row + 1, mask=live, other=0.0) * y
    u += tl.load(row + 2, mask=live, other=0.0) * z + tl.load(row + 3, mask=live, other=0.0)
    v = tl.load(row + 4, mask=live, other=0.0) * x + tl.load(row + 5, mask=live, other=0.0) * y
    v += tl.load(row + 6, mask=live, other=0.0) * z + tl.load(row + 7, mask=live, other=0.0)
    depth = tl.load(row + 8, mask=live, other=0.0) * x + tl.load(row + 9, mask=live, other=0.0) * y
    depth += tl.load(row + 10, mask=live, other=0.0) * z + tl.load(row + 11, mask=live, other=0.0)
    safe = tl.maximum(depth, min_depth)
    u, v = u / safe, v / safe
    seen = (u >= 0.0) & (v >= 0.0) & (u < width) & (v < height) & (depth > min_depth)
    seen = seen & (tl.load(valid + sample * views + view, mask=live, other=0) > 0)
    of_sample = point - sample * queries * num
    out = places + 2 * ((sample * views + view) * queries * num + of_sample)
    tl.store(out, tl.where(seen, 2.0 * (u / width) - 1.0, beyond), mask=live)
    tl.store(out + 1, tl.where(seen, 2.0 * (v / height) - 1.0, beyond), mask=live)
    spot = ((point // num) * views + view) * num + point % num
    tl.store(visible + spot, seen.to(tl.uint8), mask=live)


@triton.jit(do_not_specialize=["queries", "views", "heads", "levels", "num"])
def _weigh(  # noqa: ANN202
    logits, camera, visible, out, queries, views, heads, levels, num,  # noqa: ANN001
    BLOCK: tl.constexpr,
):  # fmt: skip
    """The softmax of one query and head."""
    query = tl.program_id(0).to(tl.int64)
    head = tl.program_id(1)
    lane = tl.arange(0, BLOCK)
    size = levels * num
    live = lane < views * size
    view, own = lane // size, lane % size
    place = (view * heads + head) * size + own
    logit = tl.load(logits + query * views * heads * size + place, mask=live, other=0.0)
    logit += tl.load(camera + (query // queries) * views * heads * size + place, mask=live, other=0.0)
    seen = live & (tl.load(visible + (query * views + view) * num + own % num, mask=live, other=0) > 0)
    highest = tl.max(tl.where(seen, logit, -3.0e38), 0)
    share = tl.where(seen, tl.exp(tl.where(seen, logit - highest, 0.0)), 0.0)
    total = tl.maximum(tl.sum(share, 0), 1e-30)
    tl.store(out + (query * heads + head) * views * size + lane, share / total, mask=live)
