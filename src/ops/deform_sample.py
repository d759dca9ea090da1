"""Bilinear sampling of sparse BEV maps and image pyramids, and the weighted sums of deformable attention."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.geometry.constants import arange, constant, where_scalar
from src.ops.backend import implementation
from src.ops.fixed_shapes import fixed_shapes
from src.ops.segment_reduce import inverse_rows, weighted_segment_sum
from src.ops.sites import Sites


def sample_sparse_bev(
    values: Tensor,  # [M, C]
    sites: Sites,  # M sites, shape (B, rows, cols)
    points: Tensor,  # [..., 2] (x, y) metres
    batch: Tensor,  # [...] int64, sample of each point
    grid: BEVGrid,
) -> Tensor:  # [..., C]
    """Bilinear values at points of a sparse map; absent cells and the outside count as zero (method 5.2).

    Equals `grid_sample(align_corners=False, padding_mode="zeros")` on the dense map, without making one. Gradients
    reach the values and the points. Computed in float32 at least, returned in the type of the values.
    """
    _check_bev(values, sites, points, batch, grid)
    rows, weights = _corners(_row_table(sites), points.reshape(-1, 2), batch.reshape(-1), grid)
    present = (rows.reshape(-1) >= 0).nonzero().squeeze(1)
    sampled = weighted_segment_sum(
        values.to(weights.dtype),
        weights.reshape(-1).index_select(0, present),
        rows.reshape(-1).index_select(0, present),
        torch.div(present, 4, rounding_mode="floor"),
        len(rows),
    )
    return sampled.to(values.dtype).view(*points.shape[:-1], values.shape[1])


def deform_attend_bev(
    values: Tensor,  # [M, heads, C / heads]
    sites: Sites,  # M sites, shape (B, rows, cols)
    points: Tensor,  # [Q, P, 2] (x, y) metres
    batch: Tensor,  # [Q] int64, sample of each query
    weights: Tensor,  # [Q, heads, P]
    grid: BEVGrid,
) -> Tensor:  # [Q, C]
    """Weighted sum over the points of every query and head of a sparse map (method 5.2).

    Gradients reach the values, the points and the weights. Raises ValueError for shapes that do not fit together.
    """
    if values.dim() != 3 or points.dim() != 3 or weights.shape != (len(points), values.shape[1], points.shape[1]):
        raise ValueError(
            "expected values [M, heads, c], points [Q, P, 2] and weights [Q, heads, P], got "
            f"{list(values.shape)}, {list(points.shape)} and {list(weights.shape)}"
        )
    if not torch.is_grad_enabled() and (values.device.type != "cpu" or fixed_shapes() is not None):
        _check_bev(values, sites, points, batch[:, None].expand(points.shape[:2]), grid)
        return implementation(attend_cells_reference)(values, _row_table(sites), points, batch, weights, grid)
    queries, num_points, _ = points.shape
    # Whole rows once, then the heads: fewer, wider segments than one per head.
    sampled = sample_sparse_bev(
        values.flatten(1), sites, points, batch[:, None].expand(queries, num_points), grid
    )  # [Q, P, C]
    by_head = sampled.view(queries, num_points, *values.shape[1:])
    return (by_head * weights.transpose(1, 2).unsqueeze(3)).sum(1).flatten(1)


def attend_cells_reference(
    values: Tensor,  # [M, heads, C / heads]
    table: Tensor,  # [B * rows * cols (+ 1)] int64, row of every cell, -1 where absent
    points: Tensor,  # [Q, P, 2] (x, y) metres
    batch: Tensor,  # [Q] int64
    weights: Tensor,  # [Q, heads, P]
    grid: BEVGrid,
) -> Tensor:  # [Q, C]
    """`deform_attend_bev` without gradient, whose shapes do not depend on what the points meet."""
    queries, num_points, _ = points.shape
    if len(values) == 0:
        return weights.new_zeros(queries, values.shape[1] * values.shape[2])
    rows, shares = _corners(table, points.flatten(0, 1), batch.repeat_interleave(num_points), grid)
    rows, shares = rows.clamp(min=0), where_scalar(rows >= 0, shares, 0.0)
    sampled = F.embedding_bag(rows, values.flatten(1).to(shares.dtype), mode="sum", per_sample_weights=shares)
    by_head = sampled.view(queries, num_points, *values.shape[1:])
    return (by_head * weights.transpose(1, 2).unsqueeze(3)).sum(1).flatten(1)


def deform_attend_images(
    values: list[Tensor],  # per level [B, N, heads * c, H_l, W_l]
    pixels: Tensor,  # [B, Q, N, P, 2] (u, v) pixels of the input image
    image_size_px: tuple[int, int],  # (H, W) of the input image
    weights: Tensor,  # [B, Q, heads, N, L, P]
    visible: Tensor | None = None,  # [B, Q, N, P] bool
) -> Tensor:  # [B, Q, heads * c]
    """Weighted sum over views, levels and points of an image pyramid (method 5.3).

    Pixel (i, j) of the input covers [j, j + 1) x [i, i + 1), cell (i, j) of a level the block of `stride` pixels from
    (stride * j, stride * i); values are bilinear between cell centres and zero outside. Points that are not `visible`
    contribute nothing; on a CPU a query without a point in a view costs nothing there. Gradients reach the values, the
    pixels and the weights. Raises ValueError for shapes that do not fit or a level that does not divide the image.
    """
    _check_images(values, pixels, image_size_px, weights)
    with torch.autocast(pixels.device.type, enabled=False):
        return _attend_images(values, pixels, image_size_px, weights, visible)


def _attend_images(
    values: list[Tensor], pixels: Tensor, image_size_px: tuple[int, int], weights: Tensor, visible: Tensor | None
) -> Tensor:
    """Samples of what is seen, by the form of the device."""
    dtype = torch.promote_types(pixels.dtype, torch.float32)
    size = constant(tuple(image_size_px[::-1]), dtype, pixels.device)
    unit = pixels.to(dtype) / size  # [B, Q, N, P, 2], the image is [0, 1) x [0, 1)
    weights = weights.to(dtype)
    # Half a cell beyond the edge still mixes with the border cells.
    reach = max(0.5 / level.shape[axis] for level in values for axis in (3, 4))
    seen = ((unit > -reach) & (unit < 1 + reach)).all(4)  # [B, Q, N, P]
    if visible is not None:
        seen = seen & visible
    # Elsewhere samples are zero already, except that a point behind a camera may lie anywhere, NaN included.
    unit = where_scalar(seen.unsqueeze(4), unit, -1.0)
    places = (2 * unit - 1).transpose(1, 2).flatten(0, 1)  # [B * N, Q, P, 2]
    images = [level.to(dtype).flatten(0, 1) for level in values]
    if pixels.device.type == "cpu":
        out = _sum_by_image(images, places, weights, seen)
    else:
        out = attend_views(images, places, weights)
    return out.to(values[0].dtype)


def attend_views(
    images: list[Tensor],  # per level [B * N, heads * c, H_l, W_l]
    places: Tensor,  # [B * N, Q, P, 2] in -1..1 of the image
    weights: Tensor,  # [B, Q, heads, N, L, P]
) -> Tensor:  # [B, Q, heads * c]
    """Sums of samples, on a GPU; without gradient by the backend's kernel."""
    attend = attend_views_reference if torch.is_grad_enabled() else implementation(attend_views_reference)
    return attend(images, places, weights)


def attend_views_reference(
    images: list[Tensor],  # per level [B * N, heads * c, H_l, W_l]
    places: Tensor,  # [B * N, Q, P, 2] in -1..1 of the image
    weights: Tensor,  # [B, Q, heads, N, L, P]
) -> Tensor:  # [B, Q, heads * c]
    """`grid_sample` per level, for all queries in all images: on a GPU the zeros cost less than launches and a wait."""
    batch_size, _, heads, views = weights.shape[:4]
    total = 0
    shares = weights.permute(4, 0, 3, 2, 1, 5).flatten(1, 2)  # [L, B * N, heads, Q, P]
    for level, share in zip(images, shares, strict=True):
        sampled = F.grid_sample(level, places, align_corners=False)  # [B * N, C, Q, P]
        total = total + (sampled.unflatten(1, (heads, -1)) * share.unsqueeze(2)).sum(4)  # [B * N, heads, c, Q]
    return total.unflatten(0, (batch_size, views)).sum(1).flatten(1, 2).transpose(1, 2)


def _sum_by_image(
    images: list[Tensor],  # per level [B * N, heads * c, H_l, W_l]
    places: Tensor,  # [B * N, Q, P, 2] in -1..1 of the image
    weights: Tensor,  # [B, Q, heads, N, L, P]
    seen: Tensor,  # [B, Q, N, P] bool
) -> Tensor:  # [B, Q, heads * c]
    """`grid_sample` per image and level, for the queries that have a point in that image."""
    batch_size, queries, heads, views, _, _ = weights.shape
    used = seen.any(3).permute(0, 2, 1)  # [B, N, Q]
    counts = used.sum(2).flatten().tolist()
    chosen = (torch.nonzero_static(used.flatten(), size=sum(counts)).squeeze(1) % queries).split(counts)

    # One image at a time; unbind, because the gradient of an index would fill the whole tensor for every image.
    by_image = zip(*(level.unbind(0) for level in images), strict=True)
    shares = weights.permute(0, 3, 4, 2, 1, 5).flatten(0, 1).unbind(0)  # B * N of [L, heads, Q, P]
    out = weights.new_zeros(batch_size * queries, images[0].shape[1])
    for image, (maps, place, share, rows) in enumerate(zip(by_image, places.unbind(0), shares, chosen, strict=True)):
        if len(rows) == 0:
            continue
        place = place.index_select(0, rows).unsqueeze(0)  # [1, q, P, 2]
        share = share.index_select(2, rows).unsqueeze(2)  # [L, heads, 1, q, P]
        total = 0
        for level, level_share in zip(maps, share, strict=True):
            sampled = F.grid_sample(level.unsqueeze(0), place, align_corners=False)  # [1, C, q, P]
            total = total + (sampled.view(heads, -1, *sampled.shape[2:]) * level_share).sum(3)  # [heads, c, q]
        # The queries of one image are distinct, so the sum does not depend on the order of the additions.
        out.index_add_(0, rows + image // views * queries, total.flatten(0, 1).t())
    return out.view(batch_size, queries, images[0].shape[1])


def _corners(
    table: Tensor,  # of `_row_table`
    points: Tensor,  # [n, 2]
    batch: Tensor,  # [n]
    grid: BEVGrid,
) -> tuple[Tensor, Tensor]:  # [n, 4] int64, [n, 4]
    """Rows of the four cells around each point, -1 where absent, and their bilinear weights."""
    dtype = torch.promote_types(points.dtype, torch.float32)
    place = grid.to_cells(points.to(dtype)) - 0.5
    low = place.detach().floor()
    part = place - low  # [n, 2]
    across = torch.stack([1 - part[:, 0], part[:, 0]], 1)  # [n, 2] over columns
    down = torch.stack([1 - part[:, 1], part[:, 1]], 1)  # [n, 2] over rows
    weights = (down.unsqueeze(2) * across.unsqueeze(1)).flatten(1)

    step = arange(2, torch.int64, points.device)
    # Clamping before the conversion to integers keeps NaN and far points out.
    low = low.nan_to_num(-2).clamp(-2, max(grid.cells)).long()
    col, row = low[:, :1] + step, low[:, 1:] + step
    inside = ((row >= 0) & (row < grid.rows)).unsqueeze(2) & ((col >= 0) & (col < grid.cols)).unsqueeze(1)
    linear = (batch[:, None] * grid.rows + row).unsqueeze(2) * grid.cols + col.unsqueeze(1)
    inside, linear = inside.flatten(1), linear.flatten(1)
    rows = table.index_select(0, where_scalar(inside, linear, 0).flatten()).view_as(linear)
    return where_scalar(inside, rows, -1), weights


def _row_table(sites: Sites) -> Tensor:  # [B * rows * cols + 1] int64
    """Row of every cell of the grid, -1 where absent; made once per set of sites."""
    if "row_table" not in sites.cache:
        # One more, which padding takes in fixed shapes.
        sites.cache["row_table"] = inverse_rows(sites.linear(), torch.Size(sites.shape).numel() + 1)
    return sites.cache["row_table"]


def _check_bev(values: Tensor, sites: Sites, points: Tensor, batch: Tensor, grid: BEVGrid) -> None:
    if sites.shape[1:] != (grid.rows, grid.cols) or len(values) != len(sites):
        raise ValueError(
            f"{len(values)} rows of values on sites of shape {sites.shape} with {len(sites)} rows: expected as many "
            f"rows and a map of {(grid.rows, grid.cols)} cells"
        )
    if points.shape[-1] != 2 or batch.shape != points.shape[:-1]:
        raise ValueError(f"expected points [..., 2] and batch [...], got {list(points.shape)} and {list(batch.shape)}")


def _check_images(values: list[Tensor], pixels: Tensor, image_size_px: tuple[int, int], weights: Tensor) -> None:
    batch_size, queries, views, points = pixels.shape[:4]
    expected = (batch_size, queries, weights.shape[2], views, len(values), points)
    if weights.shape != expected:
        raise ValueError(f"weights: expected [B, Q, heads, N, L, P] = {list(expected)}, got {list(weights.shape)}")
    for level, maps in enumerate(values):
        if maps.shape[:2] != (batch_size, views) or maps.shape[2] % weights.shape[2]:
            raise ValueError(
                f"values[{level}]: expected [{batch_size}, {views}, a multiple of {weights.shape[2]} channels, H, W], "
                f"got {list(maps.shape)}"
            )
        if image_size_px[0] * maps.shape[4] != image_size_px[1] * maps.shape[3] or image_size_px[0] % maps.shape[3]:
            raise ValueError(
                f"values[{level}]: a map of {tuple(maps.shape[3:])} cells does not divide an image of {image_size_px} "
                "pixels into square cells; choose an image size that the strides divide"
            )
