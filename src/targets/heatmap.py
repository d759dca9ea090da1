"""Targets of the sparse CenterPoint head: Gaussians over active cells and box codes at the nearest ones (method 7)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.geometry.constants import arange, constant
from src.geometry.ragged import enumerate_items
from src.ops.sites import Sites
from src.structures.boxes import Boxes3D
from src.structures.taxonomy import CLASSES
from src.targets.supervision import supervised_boxes, upload_boxes

HEAD_GROUPS: tuple[tuple[str, ...], ...] = (
    ("car",),
    ("truck", "other_vehicle"),
    ("bus", "trailer"),
    ("barrier",),
    ("motorcycle", "bicycle"),
    ("pedestrian", "traffic_cone", "animal"),
    ("traffic_sign",),
)
"""Classes that share one set of regression branches and one NMS (table of method 7)."""

GROUP_OF_CLASS: tuple[int, ...] = tuple(
    next(number for number, group in enumerate(HEAD_GROUPS) if name in group) for name in CLASSES
)

CODE_SIZE = 10
"""Box code: dx, dy (cells), z (m), log length, log width, log height (log m), cos yaw, sin yaw, vx, vy (m/s)."""

MIN_OVERLAP = 0.1
MIN_RADIUS_CELLS = 2
MAX_DISTANCE_CELLS = 8.0
MAX_OBJECTS_PER_GROUP = 500
# exp(-7^2 / 2) = 2e-11; in float32 the loss weight (1 - y)^4 is 1 below 3e-8, so the cut changes nothing there.
REACH_SIGMAS = 7.0


@dataclass
class HeadTargets:
    """What the head should predict for one batch; rows index the sites the targets were made for.

    `num_distant` counts boxes without a non-empty cell within 8 cells, which supervise nothing; `num_shared` objects
    whose cell also belongs to another object of the same group (both keep their code, the head cannot meet both).
    """

    heatmap: Tensor  # [M, 12] in 0..1, columns as taxonomy.CLASSES
    rows: Tensor  # [K] int64, row of each object's cell
    labels: Tensor  # [K] int64, index into taxonomy.CLASSES
    groups: Tensor  # [K] int64, index into HEAD_GROUPS
    codes: Tensor  # [K, CODE_SIZE], see CODE_SIZE; velocities NaN where unknown
    attributes: Tensor  # [K] int64, -1 for none
    num_distant: int
    num_shared: Tensor  # [] int64


def gaussian_radius(
    length: Tensor,  # [K] cells
    width: Tensor,  # [K] cells
    min_overlap: float,
) -> Tensor:  # [K] cells
    """Radius within which a shifted box still overlaps enough, in the published form of CornerNet.

    The roots of the second and third case are divided by 2 instead of 2a there; at overlap 0.1 that gives about twice
    the radius of the corrected formula, and every public CenterPoint is trained with it.
    """
    total, area = length + width, length * width
    shifted = total + (total**2 - 4 * area * (1 - min_overlap) / (1 + min_overlap)).sqrt()
    inner = 2 * total + (4 * total**2 - 16 * (1 - min_overlap) * area).sqrt()
    outer = -2 * min_overlap * total
    outer = outer + (outer**2 - 16 * min_overlap * (min_overlap - 1) * area).sqrt()
    return torch.stack([shifted, inner, outer]).amin(0) / 2


def head_targets(
    boxes: list[Boxes3D],  # B, augmented ego frame
    sites: Sites,  # non-empty cells, shape (B, rows, cols)
    grid: BEVGrid,
) -> HeadTargets:
    """Heat map and box codes of a batch (method 7; VoxelNeXt's assignment with our guard).

    With g = (xy - lower corner) / cell, an object belongs to the non-empty cell j that minimises |(col, row) - g|: a
    cell stands for its lower corner, as in the public heads. Ties go to the lowest key. The heat map is the maximum of
    exp(-|cell - g|^2 / 2 sigma^2) and exp(-|cell - j|^2 / 2 sigma^2) over the objects of a class.
    """
    joined, batch = supervised_boxes(boxes, grid)
    joined, batch = _first_of_each_group(joined, batch)
    g = grid.to_cells(joined.centers[:, :2])
    radius = gaussian_radius(joined.sizes[:, 0] / grid.cell_m, joined.sizes[:, 1] / grid.cell_m, MIN_OVERLAP)
    sigma = (2 * radius.floor().clamp(min=MIN_RADIUS_CELLS) + 1) / 6
    own = [joined.centers[:, 2:], joined.sizes.log(), joined.yaws.cos()[:, None], joined.yaws.sin()[:, None]]
    codes = torch.cat([*own, joined.velocities], dim=1)  # without the offset, which the cell decides
    groups = constant(GROUP_OF_CLASS, torch.int64, batch.device)[joined.labels]
    # What the boxes alone decide is known; the rest needs the cells, where they lie.
    joined, batch, g, sigma, codes, groups = upload_boxes(joined, batch, g, sigma, codes, groups, device=sites.device)
    rows, near = _nearest_cells(g, batch, sites)
    kept = near.nonzero().squeeze(1)
    batch, g, rows, sigma, codes, groups = (x[kept] for x in (batch, g, rows, sigma, codes, groups))
    labels, attributes = joined.labels[kept], joined.attributes[kept]

    cell = sites.indices()[rows, 1:].flip(1).to(g.dtype)  # [K, 2] (col, row)
    heatmap = _draw(torch.cat([g, cell]), sigma.repeat(2), batch.repeat(2), labels.repeat(2), sites, len(CLASSES))
    places = (rows * len(HEAD_GROUPS) + groups).sort().values
    equal = places[1:] == places[:-1]
    return HeadTargets(
        heatmap=heatmap,
        rows=rows,
        labels=labels,
        groups=groups,
        codes=torch.cat([g - cell, codes], dim=1),
        attributes=attributes,
        num_distant=len(near) - len(rows),
        num_shared=(F.pad(equal, (1, 0)) | F.pad(equal, (0, 1))).sum() if len(rows) else torch.zeros_like(rows).sum(),
    )


def _first_of_each_group(boxes: Boxes3D, batch: Tensor) -> tuple[Boxes3D, Tensor]:
    """At most MAX_OBJECTS_PER_GROUP boxes of every sample and group, in their order."""
    if len(boxes) <= MAX_OBJECTS_PER_GROUP:
        return boxes, batch
    owner = batch * len(HEAD_GROUPS) + constant(GROUP_OF_CLASS, torch.int64, batch.device)[boxes.labels]
    owner, order = owner.sort(stable=True)
    place = arange(len(owner), torch.int64, owner.device) - torch.searchsorted(owner, owner)
    kept = order[place < MAX_OBJECTS_PER_GROUP].sort().values
    return boxes[kept], batch[kept]


def _pairs_in_bands(
    g: Tensor,  # [K, 2] (x, y) cells
    reach: Tensor,  # [K] cells
    batch: Tensor,  # [K] int64
    sites: Sites,
) -> tuple[Tensor, Tensor, Tensor]:  # [pairs], [pairs] int64, [pairs] cells^2
    """All (object, site) pairs of one sample within `reach`, and their squared distance; ascending in both.

    Sites are sorted by row, so the sites of a band of rows are one contiguous range: only those are compared.
    """
    _, height, width = sites.shape
    low = (g[:, 1] - reach).ceil().long().clamp(0, height)
    high = (g[:, 1] + reach).floor().long().clamp(-1, height - 1) + 1
    linear = sites.linear()
    start = torch.searchsorted(linear, (batch * height + low) * width)
    stop = torch.searchsorted(linear, (batch * height + high) * width)
    owners, offsets = enumerate_items((stop - start).clamp(min=0))
    rows = start[owners] + offsets
    cells = sites.indices()[:, 1:].to(g.dtype)
    squared = (cells[rows, 1] - g[owners, 0]) ** 2 + (cells[rows, 0] - g[owners, 1]) ** 2
    within = (squared <= reach[owners] ** 2).nonzero().squeeze(1)
    return owners[within], rows[within], squared[within]


def _nearest_cells(
    g: Tensor,  # [K, 2] (x, y) cells
    batch: Tensor,  # [K] int64
    sites: Sites,
) -> tuple[Tensor, Tensor]:  # [K] int64, [K] bool
    """Row of the nearest site of each object, and whether there is one within MAX_DISTANCE_CELLS."""
    owners, rows, squared = _pairs_in_bands(g, torch.full_like(g[:, 0], MAX_DISTANCE_CELLS), batch, sites)
    least = g.new_full((len(g),), torch.inf).scatter_reduce_(0, owners, squared, "amin")
    found = torch.full_like(batch, len(sites))
    found.scatter_reduce_(0, owners, torch.where(squared == least[owners], rows, len(sites)), "amin")
    return found, found < len(sites)


def _draw(
    g: Tensor,  # [n, 2] (x, y) cells
    sigma: Tensor,  # [n] cells
    batch: Tensor,  # [n] int64
    labels: Tensor,  # [n] int64
    sites: Sites,
    num_classes: int,
) -> Tensor:  # [M, num_classes]
    """Maximum over the Gaussians of each class at every site."""
    owners, rows, squared = _pairs_in_bands(g, REACH_SIGMAS * sigma, batch, sites)
    values = torch.exp(-squared / (2 * sigma[owners] ** 2))
    flat = g.new_zeros(len(sites) * num_classes)
    flat.scatter_reduce_(0, rows * num_classes + labels[owners], values, "amax")
    return flat.view(len(sites), num_classes)
