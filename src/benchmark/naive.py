"""Splatting and the smaller operations beside their naive implementations."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from src.benchmark.parts import tensors_in
from src.benchmark.scenes import ROADS, Highway
from src.benchmark.timing import MODES, added_mib, clock, interleaved, ratio_columns
from src.config import Config
from src.geometry.bev_grid import BEVGrid
from src.geometry.box_cells import cells_in_boxes
from src.ops.deform_sample import deform_attend_images, sample_sparse_bev
from src.ops.farthest_point import farthest_points
from src.ops.kernel_maps import submanifold_map
from src.ops.segment_reduce import segment_sum
from src.ops.sites import Sites
from src.ops.splat import splat_gaussians
from src.ops.voxelize import voxelize
from src.structures.sparse_bev import SparseMap

ROUNDS, BUDGET_S = 9, 8.0
STD_RANGE_M = (0.5, 4.0)  # standard deviations of the Gaussians, log-uniform
POINTS_PER_QUERY = 11
VIEWS, HEADS, LEVEL_STRIDES = 4, 4, (8, 16, 32)


@dataclass(frozen=True)
class NaiveSizes:
    """How large the operations are; the channels are the model's."""

    road: Highway
    cells: int  # of a sparse BEV map, and per remembered frame a quarter of it
    frames: int
    gaussians: int
    queries: int  # of samples and attention
    picks: int  # of farthest point sampling
    boxes: int
    rows: int  # of the segment sum
    splat_subset: int  # Gaussians of the dense splat that are computed; time and memory are then multiplied


SIZES = {
    # The sizes at which formulations were chosen: 19 thousand voxels, 8 thousand cells, 2560 Gaussians.
    "paper": NaiveSizes(ROADS["paper"], 8000, 8, 2560, 2560, 256, 80, 60_000, 160),
    "mini": NaiveSizes(ROADS["mini"], 2000, 4, 640, 640, 64, 40, 15_000, 160),
    "debug": NaiveSizes(Highway(200, 60, 2, 150.0), 200, 2, 32, 32, 8, 5, 500, 16),
}


Gaussians = dict[str, Tensor]
Candidates = tuple[Callable[[], Any], Callable[[], Any]]
"""Ours and the naive implementation."""


def random_gaussians(number: int, channels: int, grid: BEVGrid, device: torch.device) -> Gaussians:
    """Gaussians of all sizes, three fifths of them in clusters; what `splat_gaussians` takes."""
    draw = torch.Generator().manual_seed(0)
    half = torch.tensor(grid.half_extent_m)
    centres = (2 * torch.rand(60, 2, generator=draw) - 1) * half
    clustered = round(0.6 * number)
    near = centres[torch.randint(0, 60, (clustered,), generator=draw)] + 3.0 * torch.randn(clustered, 2, generator=draw)
    means = torch.cat([near, (2 * torch.rand(number - clustered, 2, generator=draw) - 1) * half])
    low, high = STD_RANGE_M
    angle = 2 * math.pi * torch.rand(number, generator=draw)
    made = {
        "means": means,
        "scales": low * torch.exp(torch.rand(number, 2, generator=draw) * math.log(high / low)),
        "directions": torch.stack([angle.cos(), angle.sin()], 1),
        "opacity_logits": 2 * torch.randn(number, generator=draw) - 0.5,
        "features": torch.randn(number, channels, generator=draw),
    }
    return {name: value.to(device).requires_grad_() for name, value in made.items()}


def splat_candidates(gaussians: Gaussians, grid: BEVGrid, subset: int) -> Candidates:
    """Every Gaussian at every cell, of a subset of them."""
    batch = torch.zeros(len(gaussians["means"]), dtype=torch.int64, device=gaussians["means"].device)
    options = {"threshold": 0.1, "max_cells": 32768, "support_sigmas": 3.0}

    def ours() -> tuple[Tensor, Tensor]:
        splat = splat_gaussians(**gaussians, batch=batch, grid=grid, batch_size=1, **options)
        return splat.log_free, splat.features

    few = {name: value[:subset].detach().requires_grad_() for name, value in gaussians.items()}
    with torch.no_grad():
        occupied = splat_gaussians(**gaussians, batch=batch, grid=grid, batch_size=1, **options).occupied.linear()
    return ours, lambda: dense_splat(few, occupied, grid, options["support_sigmas"])


def dense_splat(gaussians: Gaussians, occupied: Tensor, grid: BEVGrid, support_sigmas: float) -> tuple[Tensor, Tensor]:
    """Eq. 4-6 as they are written: every Gaussian against every cell, features at the occupied ones."""
    offset = all_centres(grid, occupied.device) - gaussians["means"][:, None]  # [G, cells, 2]
    cosine, sine = gaussians["directions"][:, None].unbind(-1)
    along = (cosine * offset[..., 0] + sine * offset[..., 1]) / gaussians["scales"][:, :1]
    across = (cosine * offset[..., 1] - sine * offset[..., 0]) / gaussians["scales"][:, 1:]
    q = along.square() + across.square()
    kernel = torch.where(q <= support_sigmas**2, torch.exp(-0.5 * q), 0.0)
    contribution = (gaussians["opacity_logits"].sigmoid()[:, None] * kernel).clamp(max=1 - 1e-4)
    return torch.log1p(-contribution).sum(0), kernel.index_select(1, occupied).t() @ gaussians["features"]


def all_centres(grid: BEVGrid, device: torch.device) -> Tensor:  # [rows * cols, 2] m
    """Centre of every cell, row by row."""
    cells = torch.cartesian_prod(torch.arange(grid.rows, device=device), torch.arange(grid.cols, device=device))
    return grid.centre_of(cells)


def measure_operations(
    config: Config, sizes: NaiveSizes, grid: BEVGrid, points: Tensor, bev: Sites, device: torch.device
) -> list[dict[str, Any]]:
    """Rows of operations that are not bound by matrix products: ours against the naive implementation."""
    draw, channels = torch.Generator(device=device).manual_seed(1), config.model.channels
    gaussians = random_gaussians(sizes.gaussians, channels, grid, device)
    rows = compare(
        "splat",
        "every Gaussian at every cell",
        splat_candidates(gaussians, grid, sizes.splat_subset),
        device,
        times=sizes.gaussians / min(sizes.splat_subset, sizes.gaussians),
    )
    rows += compare("segment sum", "index_add", segment_candidates(sizes, channels, draw, device), device)
    sampling = sampling_candidates(sizes, channels, grid, bev, draw)
    rows += compare("bilinear sampling", "densify + grid_sample", sampling, device)
    attention = attention_candidates(config, sizes, draw, device)
    rows += compare("image attention", "all views grid_sample", attention, device)
    spots = 2 * torch.rand(sizes.gaussians, 2, generator=draw, device=device) - 1
    spots = spots * torch.tensor(grid.half_extent_m, device=device)
    valid = torch.ones(1, sizes.gaussians, dtype=torch.bool, device=device)
    start = torch.zeros(1, dtype=torch.int64, device=device)
    picking = (
        lambda: farthest_points(spots[None], valid, start, sizes.picks),
        lambda: naive_farthest_points(spots, sizes.picks),
    )
    rows += compare("farthest points", "plain loop", picking, device)
    car = torch.tensor([[4.5, 1.9, 0.4]], device=device)  # length, width, yaw
    boxes = torch.cat([spots[: sizes.boxes], car.expand(min(sizes.boxes, len(spots)), 3)], 1)
    raster = lambda: cells_in_boxes(boxes, grid, 4.8), lambda: dense_raster(boxes, grid, 4.8)
    rows += compare("box raster", "every box at every cell", raster, device)
    owners = torch.zeros(len(points), dtype=torch.int64, device=device)
    lower, size = (grid.x_min_m, grid.y_min_m, grid.z_range_m[0]), (0.1, 0.1, 0.2)
    shape = (round((grid.z_range_m[1] - grid.z_range_m[0]) / size[2]), 8 * grid.rows, 8 * grid.cols)
    voxels = (
        lambda: voxelize(points, points[:, :3], owners, lower, size, shape, 1)[1],
        lambda: naive_voxels(points, lower, size),
    )
    rows += compare("voxels", "unique rows + index_add", voxels, device)
    sites, *_ = voxelize(points, points[:, :3], owners, lower, size, shape, 1)
    return rows + compare("kernel map", "a search for each neighbour", map_candidates(sites), device)


def compare(
    operation: str, naive_name: str, candidates: Candidates, device: torch.device, times: float = 1.0
) -> list[dict[str, Any]]:
    """Time both in turns, forward and, where the result has a gradient, with backward; `times` the naive one counts."""
    trained = any(x.requires_grad for x in tensors_in(candidates[0]()))
    rows = []
    for mode, wrap in MODES.items():
        if mode == "forward" or trained:
            wrapped = dict(zip(("ours", "naive"), map(wrap, candidates), strict=True))
            row = {"operation": operation, "mode": mode, "naive implementation": naive_name}
            row |= ratio_columns(interleaved(wrapped, clock(device), ROUNDS, BUDGET_S), {"naive": times})
            row |= {f"{name} added MiB": added_mib(function, device) for name, function in wrapped.items()}
            if row["naive added MiB"] is not None:
                row["naive added MiB"] *= times
            rows.append(row)
    return rows


def segment_candidates(sizes: NaiveSizes, channels: int, draw: torch.Generator, device: torch.device) -> Candidates:
    """Rows that meet three at a time."""
    values = torch.randn(sizes.rows, channels, generator=draw, device=device, requires_grad=True)
    owners = torch.randint(0, sizes.rows // 3, (sizes.rows,), generator=draw, device=device)
    zeros = torch.zeros(sizes.rows // 3, channels, device=device)
    return lambda: segment_sum(values, owners, len(zeros)), lambda: zeros.index_add(0, owners, values)


def sampling_candidates(
    sizes: NaiveSizes, channels: int, grid: BEVGrid, bev: Sites, draw: torch.Generator
) -> Candidates:
    """Eleven points per query around cells of a sparse map."""
    device = bev.device
    values = torch.randn(len(bev), channels, generator=draw, device=device, requires_grad=True)
    homes = torch.randint(0, len(bev), (sizes.queries,), generator=draw, device=device)
    centres = grid.centre_of(bev.indices()[homes, 1:])
    spread = 2.0 * torch.randn(sizes.queries, POINTS_PER_QUERY, 2, generator=draw, device=device)
    points = (centres[:, None] + spread).requires_grad_()
    owners = torch.zeros(points.shape[:2], dtype=torch.int64, device=device)
    size = torch.tensor([grid.cols, grid.rows], device=device)

    def ours() -> Tensor:
        return sample_sparse_bev(values, Sites(bev.shape, bev.keys), points, owners, grid)

    def dense() -> Tensor:
        unit = 2 * grid.to_cells(points) / size - 1
        return F.grid_sample(SparseMap(bev, values).to_dense(), unit[None], align_corners=False)

    return ours, dense


def attention_candidates(config: Config, sizes: NaiveSizes, draw: torch.Generator, device: torch.device) -> Candidates:
    """Queries that each lie in about one of the views, as around a truck."""
    height, width = config.backbone.image_size_px
    channels, queries = config.model.channels, sizes.queries
    levels = [
        torch.randn(1, VIEWS, channels, height // stride, width // stride, generator=draw, device=device)
        for stride in LEVEL_STRIDES
    ]
    levels = [level.requires_grad_() for level in levels]
    extent = torch.tensor([width, height], device=device)
    shape = (1, queries, VIEWS, POINTS_PER_QUERY)
    pixels = torch.rand(1, queries, 1, 1, 2, generator=draw, device=device) * extent
    pixels = (pixels + 20.0 * torch.randn(*shape, 2, generator=draw, device=device)).requires_grad_()
    home = torch.randint(0, VIEWS, (1, queries, 1), generator=draw, device=device)
    visible = (home == torch.arange(VIEWS, device=device))[..., None].expand(shape)
    weights = torch.rand(1, queries, HEADS, VIEWS, len(levels), POINTS_PER_QUERY, generator=draw, device=device)
    weights.requires_grad_()

    def ours() -> Tensor:
        return deform_attend_images(levels, pixels, (height, width), weights, visible)

    def everywhere() -> Tensor:
        return attend_everywhere(levels, pixels, (height, width), weights, visible)

    return ours, everywhere


def attend_everywhere(
    levels: Sequence[Tensor], pixels: Tensor, image_size_px: tuple[int, int], weights: Tensor, visible: Tensor
) -> Tensor:  # [B, Q, C]
    """Sample every point in every view, then mask: the same sum without choosing queries."""
    b, q, n, p, _ = pixels.shape
    heads = weights.shape[2]
    unit = 2 * pixels / pixels.new_tensor(image_size_px[::-1]) - 1  # [B, Q, N, P, 2]
    places = unit.permute(0, 2, 1, 3, 4).flatten(0, 1)  # [B*N, Q, P, 2]
    total: Any = 0.0
    for number, level in enumerate(levels):
        sampled = F.grid_sample(level.flatten(0, 1), places, align_corners=False)  # [B*N, C, Q, P]
        sampled = sampled.view(b, n, heads, -1, q, p)
        weighed = (weights[:, :, :, :, number] * visible[:, :, None]).permute(0, 3, 2, 1, 4)  # [B, N, heads, Q, P]
        total = total + torch.einsum("bnhcqp,bnhqp->bqhc", sampled, weighed)
    return total.flatten(2)


def map_candidates(sites: Sites) -> Candidates:
    """The pairs of a 3x3x3 submanifold convolution, input below output."""
    offsets = torch.cartesian_prod(*[torch.arange(-1, 2, device=sites.device)] * 3)
    moved = F.pad(offsets, (1, 0))[:, None] + sites.indices()  # [27, n, 4]

    def ours() -> Tensor:
        pairs = submanifold_map(Sites(sites.shape, sites.keys), 3)
        return torch.stack([pairs.inputs, pairs.outputs])

    def naive() -> Tensor:
        rows = torch.cat([sites.rows_of(cells) for cells in moved])
        found = (rows >= 0).nonzero().squeeze(1)
        return torch.stack([rows[found], found % len(sites)])

    return ours, naive


def naive_farthest_points(points: Tensor, count: int) -> Tensor:
    """A loop over picks: distances to the last one, minimum, argmax."""
    picks = points.new_zeros(count, dtype=torch.int64)
    gap = points.new_full((len(points),), math.inf)
    for step in range(1, count):
        gap = torch.minimum(gap, (points - points[picks[step - 1]]).square().sum(1))
        picks[step] = gap.argmax()
    return picks


def dense_raster(boxes: Tensor, grid: BEVGrid, margin_m: float) -> Tensor:
    """Every box against every cell centre."""
    offset = all_centres(grid, boxes.device).double() - boxes[:, None, :2].double()
    cosine, sine = boxes[:, 4:].double().cos(), boxes[:, 4:].double().sin()
    along = (cosine * offset[..., 0] + sine * offset[..., 1]).abs() <= 0.5 * (boxes[:, 2:3] + margin_m)
    across = (cosine * offset[..., 1] - sine * offset[..., 0]).abs() <= 0.5 * (boxes[:, 3:4] + margin_m)
    return (along & across).nonzero()


def naive_voxels(points: Tensor, lower_m: Sequence[float], size_m: Sequence[float]) -> Tensor:
    """Distinct rows of voxel indices, and means by scattered addition."""
    cells = ((points[:, :3] - points.new_tensor(lower_m)) / points.new_tensor(size_m)).floor().long()
    voxels, owners = torch.unique(cells, dim=0, return_inverse=True)
    sums = points.new_zeros(len(voxels), points.shape[1]).index_add(0, owners, points)
    counts = points.new_zeros(len(voxels)).index_add(0, owners, torch.ones_like(points[:, 0]))
    return sums / counts[:, None]
