"""A z-buffer in numpy: every quad becomes row spans, every span pixels, the nearest quad wins each pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Array = np.ndarray

NEAR_M = 0.3


@dataclass(kw_only=True)
class Drawn:
    """Which quad each pixel shows, and how far away it is."""

    quad: Array  # [H * W] row of the input, -1 for background
    depth_m: Array  # [H * W] along the optical axis, inf for background
    own_pixels: Array  # [G] pixels that each group would fill if nothing stood before it
    seen_pixels: Array  # [G] pixels that show it


def _clip_near(corners: Array) -> Array:
    """One quad cut at the near plane: quads [k, 4, 3] with k of 0 to 2."""
    kept = []
    for here, after in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if here[2] > NEAR_M:
            kept.append(here)
        if (here[2] > NEAR_M) != (after[2] > NEAR_M):
            kept.append(here + (after - here) * ((NEAR_M - here[2]) / (after[2] - here[2])))
    if len(kept) < 3:
        return np.zeros((0, 4, 3))
    fan = [[kept[0], kept[1], kept[2], kept[min(3, len(kept) - 1)]]]
    if len(kept) == 5:
        fan.append([kept[0], kept[3], kept[4], kept[4]])
    return np.array(fan)


def draw_quads(
    corners: Array,  # [Q, 4, 3] m, camera axes
    two_sided: Array,  # [Q] bool
    layer: Array,  # [Q] factor on inverse depth
    group: Array,  # [Q] object number, -1 for scenery
    num_groups: int,
    intrinsic: Array,  # [3, 3]
    width: int,
    height: int,
) -> Drawn:
    """Draw Q planar quads into a z-buffer of width x height pixels."""
    normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    plane = np.einsum("qi,qi->q", normals, corners[:, 0])
    z = corners[..., 2]
    front = np.flatnonzero((two_sided | (plane < 0)) & (z.max(1) > NEAR_M) & (np.abs(plane) > 1e-9))
    crossing = front[z[front].min(1) <= NEAR_M]
    whole = front[z[front].min(1) > NEAR_M]
    cut = [_clip_near(corners[row]) for row in crossing]
    points = np.concatenate([corners[whole], *cut])
    source = np.concatenate([whole, np.repeat(crossing, [len(c) for c in cut])]).astype(np.int64)
    fx, fy, cx, cy = intrinsic[0, 0], intrinsic[1, 1], intrinsic[0, 2], intrinsic[1, 2]
    u, v = fx * points[..., 0] / points[..., 2] + cx, fy * points[..., 1] / points[..., 2] + cy
    row0 = np.clip(np.ceil(v.min(1) - 0.5), 0, height).astype(np.int64)
    rows = np.clip(np.ceil(v.max(1) - 0.5), 0, height).astype(np.int64) - row0
    rows[(u.max(1) < 0) | (u.min(1) > width)] = 0
    span_of, y, pixel_span, x = _fill(u, v, row0, rows, width)
    line = y + 0.5
    # 1/depth is affine in pixels on a plane: n.(ray * depth) = plane.
    row = source[span_of]
    scale = layer[row] / plane[row]
    slope = normals[row, 0] / fx * scale
    start = (normals[row, 0] * (0.5 - cx) / fx + normals[row, 1] * (line - cy) / fy + normals[row, 2]) * scale
    inverse = (start[pixel_span] + slope[pixel_span] * x).astype(np.float32)
    np.maximum(inverse, np.float32(1e-6), out=inverse)
    pixel = y[pixel_span] * width + x
    owner = row[pixel_span]
    key = (inverse.view(np.int32).astype(np.int64) << 32) | owner
    buffer = np.zeros(width * height, dtype=np.int64)
    np.maximum.at(buffer, pixel, key)
    quad = np.where(buffer > 0, buffer & 0xFFFFFFFF, -1)
    nearest = (buffer >> 32).astype(np.int32).view(np.float32)
    depth = np.where(buffer > 0, 1.0 / np.maximum(nearest, 1e-6), np.inf)
    own, seen = _count(group[owner], pixel, np.append(group, -1)[quad], num_groups, width * height)
    return Drawn(quad=quad, depth_m=depth, own_pixels=own, seen_pixels=seen)


def _fill(u: Array, v: Array, row0: Array, rows: Array, width: int) -> tuple[Array, Array, Array, Array]:
    """Pixels whose centres lie in convex polygons [P, 4] of image corners.

    Returns per span (one pixel row of one polygon) its polygon and row, and per pixel its span and column.
    """
    span_of, y = _expand(row0, rows)
    line = y + 0.5
    left, right = np.full(len(y), np.inf), np.full(len(y), -np.inf)
    for a in range(4):
        b = (a + 1) % 4
        va, vb = v[span_of, a], v[span_of, b]
        hit = np.flatnonzero((va <= line) != (vb <= line))
        va, vb, ua, ub = va[hit], vb[hit], u[span_of[hit], a], u[span_of[hit], b]
        x = ua + (line[hit] - va) * (ub - ua) / (vb - va)
        left[hit], right[hit] = np.minimum(left[hit], x), np.maximum(right[hit], x)
    col0 = np.clip(np.ceil(np.minimum(left, 1e6) - 0.5), 0, width).astype(np.int64)
    cols = np.clip(np.ceil(np.maximum(right, -1e6) - 0.5), 0, width).astype(np.int64) - col0
    pixel_span, x = _expand(col0, np.maximum(cols, 0))
    return span_of, y, pixel_span, x


def _expand(first: Array, count: Array) -> tuple[Array, Array]:
    """For each row i the numbers first[i] .. first[i] + count[i] - 1, flat, with the row that each belongs to."""
    owner = np.repeat(np.arange(len(count)), count)
    begin = np.cumsum(count) - count
    return owner, np.arange(len(owner)) - begin[owner] + first[owner]


def _count(group: Array, pixel: Array, shown: Array, num_groups: int, num_pixels: int) -> tuple[Array, Array]:
    """Distinct pixels per group, and those that show it."""
    labelled = np.flatnonzero(group >= 0)
    present = np.flatnonzero(np.bincount(group[labelled], minlength=num_groups))
    place = np.zeros(num_groups, dtype=np.int64)
    place[present] = np.arange(len(present))
    touched = np.zeros(len(present) * num_pixels, dtype=bool)
    touched[place[group[labelled]] * num_pixels + pixel[labelled]] = True
    own = np.zeros(num_groups, dtype=np.int64)
    own[present] = [np.count_nonzero(row) for row in touched.reshape(len(present), num_pixels)]
    return own, np.bincount(shown[shown >= 0], minlength=num_groups)
