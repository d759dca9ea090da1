"""Deformable attention to the images of all views, a Triton launch for each level: a program a query (method 5.3)."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from src.ops.backend import runs_kernels
from src.ops.deform_sample import attend_views_reference


def attend_views_triton(
    images: list[Tensor],  # per level [B * N, heads * c, H_l, W_l]
    places: Tensor,  # [B * N, Q, P, 2] in -1..1 of the image
    weights: Tensor,  # [B, Q, heads, N, L, P]
) -> Tensor:  # [B, Q, heads * c]
    """The reference's sums in float32."""
    if any(x.dtype != torch.float32 for x in (*images, places, weights)) or not runs_kernels(places):
        return attend_views_reference(images, places, weights)
    batch_size, queries, heads, views, levels, points = weights.shape
    channels = images[0].shape[1]
    out = places.new_empty(batch_size, queries, channels)
    if out.numel() > 0:
        places, weights = places.contiguous(), weights.contiguous()
        with torch.cuda.device_of(out):
            for level, image in enumerate(images):
                _attend_level[(batch_size * queries,)](
                    *(image, places, weights, out, level, levels),
                    *(queries, views, points, heads, channels, image.shape[2], image.shape[3], *image.stride()),
                    BLOCK=triton.next_power_of_2(channels),
                    num_warps=1,
                )
    return out


@triton.jit(do_not_specialize=["level", "levels", "queries", "views", "points", "heads", "height", "width"])
def _attend_level(  # noqa: ANN202
    image, places, weights, out, level, levels,  # noqa: ANN001
    queries, views, points, heads, channels, height, width,  # noqa: ANN001
    stride_image, stride_channel, stride_row, stride_col,  # noqa: ANN001
    BLOCK: tl.constexpr,
):  # fmt: skip
    """What one query gathers from one level of all views, added to what it has."""
    query = tl.program_id(0).to(tl.int64)  # of all samples
    sample, own = query // queries, query % queries
    channel = tl.arange(0, BLOCK)
    wide = channel < channels
    head = channel // (channels // heads)
    total = tl.load(out + query * channels + channel, mask=wide & (level > 0), other=0.0)
    for view in range(0, views):
        picture = image + (sample * views + view) * stride_image + channel * stride_channel
        corner = places + ((sample * views + view) * queries + own) * points * 2
        own_weights = weights + (((query * heads + head) * views + view) * levels + level) * points
        for point in range(0, points):
            x = ((tl.load(corner + 2 * point) + 1.0) * width - 1.0) * 0.5
            y = ((tl.load(corner + 2 * point + 1) + 1.0) * height - 1.0) * 0.5
            if (x > -1.0) & (x < width) & (y > -1.0) & (y < height):
                low_x, low_y = tl.floor(x), tl.floor(y)
                share = tl.load(own_weights + point, mask=wide, other=0.0)
                for step in tl.static_range(4):
                    col, row = low_x + step % 2, low_y + step // 2
                    inside = (col >= 0) & (col < width) & (row >= 0) & (row < height)
                    pixel = tl.where(inside, row.to(tl.int64) * stride_row + col.to(tl.int64) * stride_col, -1)
                    found = tl.load(picture + pixel, mask=wide & (pixel >= 0), other=0.0)
                    total += share * ((1.0 - tl.abs(x - col)) * (1.0 - tl.abs(y - row))) * found
    tl.store(out + query * channels + channel, total, mask=wide)
