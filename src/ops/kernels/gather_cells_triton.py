"""Features and centres of some cells by one Triton launch (method 4.1)."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.ops.backend import runs_kernels
from src.ops.gather_cells import gather_cells_reference


def gather_cells_triton(
    features: Tensor,  # [M, C]
    indices: Tensor,  # [M, 3] int64
    rows: Tensor,  # [B, K] int64
    grid: BEVGrid,
) -> tuple[Tensor, Tensor, Tensor]:
    """The reference's cells, centres up to rounding."""
    if features.dtype == torch.float64 or not runs_kernels(features):
        return gather_cells_reference(features, indices, rows, grid)
    means = features.new_empty((*rows.shape, 2), dtype=torch.float32)
    valid, out = rows.new_empty(rows.shape, dtype=torch.uint8), features.new_empty(*rows.shape, features.shape[1])
    if rows.numel() > 0:
        with torch.cuda.device_of(features):
            _take_cells[(rows.numel(),)](
                *(features.contiguous(), indices, rows, means, valid, out, features.shape[1], rows.shape[1]),
                *(*indices.stride(), *rows.stride(), grid.x_min_m, grid.y_min_m, grid.cell_m),
                BLOCK=triton.next_power_of_2(features.shape[1]),
                num_warps=1,
            )
    return means, valid.view(torch.bool), out


@triton.jit(do_not_specialize=["count"])
def _take_cells(  # noqa: ANN202
    features, indices, rows, means, valid, out, channels, count,  # noqa: ANN001
    cell_step, part_step, sample_step, row_step, x_min, y_min, cell_m,  # noqa: ANN001
    BLOCK: tl.constexpr,
):  # fmt: skip
    """One cell."""
    place = tl.program_id(0).to(tl.int64)
    row = tl.load(rows + place // count * sample_step + place % count * row_step)
    there = row >= 0
    cell = indices + row * cell_step
    y = tl.load(cell + part_step, mask=there, other=0).to(tl.float32)
    x = tl.load(cell + 2 * part_step, mask=there, other=0).to(tl.float32)
    tl.store(means + 2 * place, x_min + (x + 0.5) * cell_m)
    tl.store(means + 2 * place + 1, y_min + (y + 0.5) * cell_m)
    tl.store(valid + place, there.to(tl.uint8))
    channel = tl.arange(0, BLOCK)
    wide = channel < channels
    own = tl.load(features + row * channels + channel, mask=wide & there, other=0.0)
    tl.store(out + place * channels + channel, own, mask=wide)
