"""Pairs of Gaussians and cells: a launch for windows, one for their cells, one to arrange what is sorted (Eq. 4)."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.geometry.constants import arange, constant
from src.ops.backend import runs_kernels
from src.ops.gaussian_cells import (
    WINDOW_SLACK_CELLS,
    GaussianCellPairs,
    key_type,
    near_pairs_reference,
    padded_pairs_reference,
)
from src.ops.kernels.sorted_search_triton import lower_bound

LANES = 256
"""Gaussians, cells of windows or pairs of a program, one lane each."""

Candidates = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""Owner, key, q and offset of the cells of all windows, and less how many there are."""


def near_pairs_triton(
    means: Tensor,  # [G, 2]
    scales: Tensor,  # [G, 2]
    directions: Tensor,  # [G, 2]
    batch: Tensor,  # [G] int64
    grid: BEVGrid,
    num_cells: int,
    support_sigmas: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The reference's pairs, q and offsets up to rounding, each in the smallest type."""
    inputs = (means, scales, directions, batch)
    if means.dtype != torch.float32 or not runs_kernels(means):
        return near_pairs_reference(*inputs, grid, num_cells, support_sigmas)
    windows = all_windows(*inputs[:3], grid, support_sigmas)
    total = int(windows[2][-1]) if len(means) > 0 else 0
    owner, key, q, delta, _ = all_candidates(windows, *inputs[1:], grid, num_cells, support_sigmas, total, True)
    near = (key < num_cells).nonzero().squeeze(1)
    return owner.index_select(0, near), key.index_select(0, near), near, q, *delta.unbind(0)


def padded_pairs_triton(
    means: Tensor,  # [G, 2]
    scales: Tensor,  # [G, 2]
    directions: Tensor,  # [G, 2]
    batch: Tensor,  # [G] int64
    grid: BEVGrid,
    num_cells: int,
    support_sigmas: float,
    size: int,
) -> tuple[GaussianCellPairs, Tensor]:
    """The reference's pairs up to rounding, their rows in 32 bits."""
    inputs = (means, scales, directions, batch)
    if means.dtype != torch.float32 or not runs_kernels(means):
        return padded_pairs_reference(*inputs, grid, num_cells, support_sigmas, size)
    windows = all_windows(*inputs[:3], grid, support_sigmas)
    candidates = all_candidates(windows, *inputs[1:], grid, num_cells, support_sigmas, size, False)
    owner, key, q, _, missing = candidates
    key, order = torch.sort(key, stable=True)
    gaussian, by_gaussian, ordered_q = torch.empty_like(owner), torch.empty_like(owner), torch.empty_like(q)
    cell_starts, gaussian_starts = owner.new_empty(num_cells + 2), owner.new_empty(len(means) + 1)
    most = max(size, num_cells + 2, len(means) + 1)
    with torch.cuda.device_of(means):
        _arrange[(triton.cdiv(most, LANES),)](
            *(owner, q, key, order, windows[2], gaussian, ordered_q, by_gaussian, cell_starts, gaussian_starts),
            *(size, num_cells, len(means), size.bit_length()),
            BLOCK=LANES,
            num_warps=4,
        )
    pair_index = arange(size, torch.int64, means.device)
    own = (gaussian, key, None, ordered_q, pair_index, cell_starts, by_gaussian, gaussian_starts)
    return GaussianCellPairs(*own), missing


def all_windows(
    means: Tensor, scales: Tensor, directions: Tensor, grid: BEVGrid, support_sigmas: float
) -> tuple[Tensor, Tensor, Tensor]:  # [G, 3] int32, [G, 4], [G] int64
    """First column, first row and width of each window; the nearest cell and the offset of the mean from its centre;
    and where the cells of a window end in a list of all."""
    num = len(means)
    corners, bases = means.new_empty((num, 3), dtype=torch.int32), means.new_empty(num, 4)
    counts = means.new_empty(num, dtype=torch.int64)
    if num > 0:
        exact = constant((grid.x_min_m, grid.y_min_m, grid.cell_m), torch.float64, means.device)
        with torch.cuda.device_of(means):
            _window[(triton.cdiv(num, LANES),)](
                *(means.contiguous(), scales.contiguous(), directions.contiguous(), exact, corners, bases, counts),
                *(num, grid.rows, grid.cols, grid.x_min_m, grid.y_min_m, grid.cell_m),
                *(support_sigmas, WINDOW_SLACK_CELLS),
                BLOCK=LANES,
                num_warps=4,
            )
    return corners, bases, counts.cumsum(0)


def all_candidates(
    windows: tuple[Tensor, Tensor, Tensor],
    scales: Tensor,
    directions: Tensor,
    batch: Tensor,
    grid: BEVGrid,
    num_cells: int,
    support_sigmas: float,
    size: int,
    wants_offsets: bool,
) -> Candidates:
    """The first `size` cells of all windows; `num_cells` is the key of what is no pair."""
    corners, bases, ends = windows
    owner, q = bases.new_empty(size, dtype=torch.int32), bases.new_empty(size)
    key = bases.new_empty(size, dtype=key_type(num_cells))
    delta = bases.new_empty(2, size if wants_offsets else 0)
    missing = ends.new_empty(1)
    if size > 0:
        with torch.cuda.device_of(bases):
            _pair[(triton.cdiv(size, LANES),)](
                *(corners, bases, ends, scales.contiguous(), directions.contiguous(), batch),
                *(owner, key, q, delta, missing, size, len(ends), len(ends).bit_length(), grid.rows, grid.cols),
                *(num_cells, batch.stride(0), grid.cell_m, support_sigmas**2),
                DELTA=wants_offsets,
                BLOCK=LANES,
                num_warps=4,
            )
    return owner, key, q, delta, missing


@triton.jit(do_not_specialize=["num", "rows", "cols"])
def _window(  # noqa: ANN202
    means, scales, directions, exact, corners, bases, counts, num, rows, cols,  # noqa: ANN001
    x_min, y_min, cell_m, sigmas, slack,  # noqa: ANN001
    BLOCK: tl.constexpr,
):  # fmt: skip
    """The windows of a block of Gaussians; one that is nowhere has no cells."""
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = place < num
    size_x = tl.load(scales + 2 * place, mask=live, other=1.0)
    size_y = tl.load(scales + 2 * place + 1, mask=live, other=1.0)
    cosine = tl.load(directions + 2 * place, mask=live, other=1.0)
    sine = tl.load(directions + 2 * place + 1, mask=live, other=0.0)
    square_x, square_y = size_x * size_x, size_y * size_y
    along, across = cosine * cosine, sine * sine
    cells = tl.full((BLOCK,), 1, tl.int32)
    for axis in tl.static_range(2):
        if axis == 0:
            variance, first, most = along * square_x + across * square_y, x_min, cols
        else:
            variance, first, most = across * square_x + along * square_y, y_min, rows
        mean = tl.load(means + 2 * place + axis, mask=live, other=0.0)
        centre = (mean - first) / cell_m - 0.5
        reach = sigmas * tl.sqrt(variance) / cell_m + slack
        somewhere = (centre == centre) & (reach == reach)
        low = tl.minimum(tl.maximum(tl.ceil(tl.where(somewhere, centre - reach, 0.0)), 0.0), most)
        high = tl.minimum(tl.maximum(tl.floor(tl.where(somewhere, centre + reach, -1.0)), -1.0), most - 1)
        width = tl.maximum(high.to(tl.int32) - low.to(tl.int32) + 1, 0)
        nearest = tl.floor(centre + 0.5)
        corner = tl.load(exact + axis) + (nearest.to(tl.float64) + 0.5) * tl.load(exact + 2)
        tl.store(corners + 3 * place + axis, low.to(tl.int32), mask=live)
        if axis == 0:
            tl.store(corners + 3 * place + 2, width, mask=live)
        tl.store(bases + 4 * place + axis, nearest, mask=live)
        tl.store(bases + 4 * place + 2 + axis, (mean.to(tl.float64) - corner).to(tl.float32), mask=live)
        cells *= width
    tl.store(counts + place, cells.to(tl.int64), mask=live)


@triton.jit(do_not_specialize=["size", "num", "steps", "rows", "cols", "num_cells", "stride"])
def _pair(  # noqa: ANN202
    corners, bases, ends, scales, directions, batch, owners, keys, q, delta, missing,  # noqa: ANN001
    size, num, steps, rows, cols, num_cells, stride, cell_m, limit,  # noqa: ANN001
    DELTA: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """A block of the cells of all windows, window by window; behind the last one padding."""
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = place < size
    owner = lower_bound(ends, place + 1, num, steps, BLOCK)
    inside = live & (owner < num)
    owner = tl.minimum(owner, num - 1)
    own = place - tl.load(ends + owner - 1, mask=inside & (owner > 0), other=0).to(tl.int32)
    width = tl.maximum(tl.load(corners + 3 * owner + 2, mask=inside, other=1), 1)
    row = tl.load(corners + 3 * owner + 1, mask=inside, other=0) + own // width
    col = tl.load(corners + 3 * owner, mask=inside, other=0) + own % width
    base_x = tl.load(bases + 4 * owner, mask=inside, other=0.0)
    base_y = tl.load(bases + 4 * owner + 1, mask=inside, other=0.0)
    x = (col.to(tl.float32) - base_x) * cell_m - tl.load(bases + 4 * owner + 2, mask=inside, other=0.0)
    y = (row.to(tl.float32) - base_y) * cell_m - tl.load(bases + 4 * owner + 3, mask=inside, other=0.0)
    cosine = tl.load(directions + 2 * owner, mask=inside, other=1.0)
    sine = tl.load(directions + 2 * owner + 1, mask=inside, other=0.0)
    along = (cosine * x + sine * y) / tl.load(scales + 2 * owner, mask=inside, other=1.0)
    across = (cosine * y - sine * x) / tl.load(scales + 2 * owner + 1, mask=inside, other=1.0)
    distance = along * along + across * across
    near = inside & (distance <= limit)
    linear = (tl.load(batch + stride * owner, mask=inside, other=0) * rows + row) * cols + col
    tl.store(owners + place, owner, mask=live)
    tl.store(keys + place, tl.where(near, linear, num_cells), mask=live)
    tl.store(q + place, tl.where(near, distance, float("inf")), mask=live)
    if DELTA:
        tl.store(delta + place, x, mask=live)
        tl.store(delta + size + place, y, mask=live)
    if tl.program_id(0) == 0:
        tl.store(missing, -tl.load(ends + num - 1, mask=num > 0, other=0))


@triton.jit(do_not_specialize=["size", "num_cells", "num", "steps"])
def _arrange(  # noqa: ANN202
    owners, q, keys, order, ends, gaussian, ordered_q, by_gaussian, cell_starts, gaussian_starts,  # noqa: ANN001
    size, num_cells, num, steps,  # noqa: ANN001
    BLOCK: tl.constexpr,
):  # fmt: skip
    """A block of the sorted pairs, where a block of cells begins among them, and a block of Gaussians."""
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = place < size
    from_ = tl.load(order + place, mask=live, other=0)
    tl.store(gaussian + place, tl.load(owners + from_, mask=live, other=0), mask=live)
    tl.store(ordered_q + place, tl.load(q + from_, mask=live, other=0.0), mask=live)
    tl.store(by_gaussian + from_, place, mask=live)  # an order names each pair once
    edge = lower_bound(keys, tl.minimum(place, num_cells), size, steps, BLOCK)
    tl.store(cell_starts + place, edge, mask=place < num_cells + 2)
    end = tl.load(ends + place - 1, mask=(place > 0) & (place <= num), other=0)
    tl.store(gaussian_starts + place, tl.minimum(end, size).to(tl.int32), mask=place <= num)
