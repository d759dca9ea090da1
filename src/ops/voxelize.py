"""Points to voxels: the sites they occupy and the mean of their features (method 1.3)."""

from __future__ import annotations

import torch
from torch import Tensor

from src.geometry.constants import constant
from src.ops.cell_keys import cell_keys
from src.ops.fixed_shapes import fixed_shapes
from src.ops.segment_reduce import inverse_rows, rank_per_sample, segment_count, segment_mean
from src.ops.sites import Sites


def voxelize(
    points: Tensor,  # [P, F] features
    coordinates: Tensor,  # [P, d] metres in the order (x, y) or (x, y, z)
    batch: Tensor,  # [P] int64, sample of each point
    lower_m: tuple[float, ...],  # (x, y[, z]) lower corner of the grid
    voxel_size_m: tuple[float, ...],  # (x, y[, z])
    shape: tuple[int, ...],  # (y, x) or (z, y, x) voxels: reversed, as cells are (row, col)
    batch_size: int,
    max_voxels: int | None = None,
) -> tuple[Sites, Tensor, Tensor]:
    """Sites [V], mean features [V, F] and number of points [V] int64 of the voxels that hold points.

    Voxel i of an axis covers [lower + i * size, lower + (i + 1) * size). Points outside the grid or with a coordinate
    that is not finite are left out. Where a sample has more than `max_voxels` voxels, those with the most points stay,
    on ties those with the lowest index; in fixed shapes such a sample overflows. Means are float32 at least, whatever
    autocast says, and the same for any order of the points up to rounding. Raises ValueError for shapes that do not fit
    together.
    """
    if len(points) != len(batch):
        raise ValueError(f"expected one row of points for each entry of batch [{len(batch)}], got {len(points)}")
    sites, rows, inside = voxel_rows(coordinates, batch, lower_m, voxel_size_m, shape, batch_size)
    limited, fixed = max_voxels is not None and len(sites) > max_voxels, fixed_shapes()
    values = points if inside is None else points.index_select(0, inside)
    if limited and fixed is not None:  # of one sample: padding follows the voxels
        fixed.expect(sites.keys[max_voxels : max_voxels + 1], sites.end)
    elif limited:
        kept = _densest(sites, segment_count(rows, len(sites)), max_voxels)
        rows = inverse_rows(kept, len(sites)).index_select(0, rows)
        values, rows = values[rows >= 0], rows[rows >= 0]
        sites = Sites(sites.shape, sites.keys.index_select(0, kept))
    values = values.to(torch.promote_types(values.dtype, torch.float32))
    of_all = (rows, len(sites), sites.groups)
    return sites, segment_mean(values, *of_all), segment_count(*of_all)


def voxel_rows(
    coordinates: Tensor,  # [P, d] metres in the order (x, y) or (x, y, z)
    batch: Tensor,  # [P] int64, sample of each point
    lower_m: tuple[float, ...],  # (x, y[, z]) lower corner of the grid
    voxel_size_m: tuple[float, ...],  # (x, y[, z])
    shape: tuple[int, ...],  # (y, x) or (z, y, x) voxels
    batch_size: int,
) -> tuple[Sites, Tensor, Tensor | None]:
    """Sites [V] of the voxels that hold points; of the n points inside, the voxel and which they are, both [n] int64.

    What is inside, and what raises ValueError, is as for `voxelize`. In fixed shapes n is P, None says that they are
    all, and points outside have padding for their voxel.
    """
    ndim = len(shape)
    if coordinates.shape != (len(batch), ndim):
        raise ValueError(
            f"expected coordinates [{len(batch)}, {ndim}] for batch [{len(batch)}] and shape {tuple(shape)}, got "
            f"{list(coordinates.shape)}"
        )
    if len(lower_m) != ndim or len(voxel_size_m) != ndim:
        raise ValueError(f"lower_m={lower_m}, voxel_size_m={voxel_size_m}: expected {ndim} values each, as in {shape}")
    if fixed_shapes() is not None:
        grid = (tuple(lower_m), tuple(voxel_size_m), (batch_size, *shape))
        return *Sites.unique_keys(cell_keys(coordinates, batch, None, *grid, torch.float64), grid[2]), None
    place = coordinates.double() - constant(tuple(lower_m), torch.float64, coordinates.device)
    cells = (
        (place / constant(tuple(voxel_size_m), torch.float64, coordinates.device)).floor().flip(1)
    )  # [P, d] (z, y, x)
    limit = constant(tuple(shape), torch.int64, cells.device)
    inside = ((cells >= 0) & (cells < limit)).all(1)
    inside = inside.nonzero().squeeze(1)
    indices = torch.cat([batch[:, None].index_select(0, inside), cells.index_select(0, inside).long()], 1)
    sites, rows = Sites.unique(indices, (batch_size, *shape))
    return sites, rows, inside


def _densest(sites: Sites, counts: Tensor, limit: int) -> Tensor:
    """Ascending rows of the `limit` voxels with the most points of every sample."""
    order, rank = rank_per_sample(counts, sites.indices()[:, 0])
    return order[rank < limit].sort().values
