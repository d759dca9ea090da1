"""The forecast that needs no training: everything stays where the last scan saw it (lrs 7.2)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from src.geometry.bounds import Bounds
from src.geometry.constants import constant
from src.geometry.neighbours import neighbours_within
from src.geometry.tensor_transforms import invert_rigid, transform_points
from src.structures.batch import FrameBatch
from src.structures.taxonomy import EGO_BODY_M

Array = np.ndarray

RADII_RAD = tuple(np.radians([0.25, 0.5, 1.0, 2.0]))
"""A ray ends at the first point within the smallest of these around it that holds any; beyond them, on the road."""
ORIGIN_CELL_M = 0.25
"""Rays that begin in one cell see the scan from its middle ray's origin: 0.7 degrees at 10 m are the most it errs."""
CUBE_M = 2.0
"""Edge of the cubes that are seen or unseen: as wide as the gaps between the beams at 100 m."""
NEAR_M = 0.5
"""Points so near to where a ray begins have no direction to speak of."""


def static_world(
    batch: FrameBatch,
    max_range_m: float,
) -> Tensor:  # [R] m
    """Range of every ray of `batch.rays`, traced through the last scans, where everything stands still: those of all
    LiDARs at the sample's own frame and those of `batch.past`, moved by the ego's motion.

    Raises ValueError for a batch without rays or LiDAR.
    """
    if batch.rays is None or batch.lidar_points is None:
        raise ValueError("batch: the static world is looked up for FrameBatch.rays in FrameBatch.lidar_points")
    points, owners = aggregated_scan(batch)
    rays, found = batch.rays, torch.empty_like(batch.rays.ranges)
    for sample in range(len(batch)):
        own = rays.batch == sample
        arrays = (points[owners == sample], rays.origins[own], rays.directions[own])
        ranges = look_up_ranges(*(array.double().cpu().numpy() for array in arrays), max_range_m)
        found[own] = torch.from_numpy(ranges).to(found)
    return found


def aggregated_scan(
    batch: FrameBatch,
) -> tuple[Tensor, Tensor]:  # [L, 3] m in the batch's (augmented) ego frames, [L] int64 sample
    """The points of the frame's own sweeps and of the frames before it, but for those of the truck, which drives on."""
    clouds, owners = [], []
    for frame in (batch, *batch.past):
        points, own = _without_ego_body(frame)
        clouds.append(points if frame is batch else _moved(aug_from_frame(batch, frame)[own], points))
        owners.append(own)
    return torch.cat(clouds), torch.cat(owners)


def _without_ego_body(
    frame: FrameBatch,
) -> tuple[Tensor, Tensor]:  # [L, 3] m in its own (augmented) ego frames, [L] int64 sample
    points, owners = frame.lidar_points[:, :3], frame.lidar_batch
    in_ego = _moved(frame.ego_from_aug[owners], points)
    low, high = constant(EGO_BODY_M, points.dtype, points.device)
    others = ((in_ego < low) | (in_ego > high)).any(1)
    return points[others], owners[others]


def aug_from_frame(batch: FrameBatch, other: FrameBatch) -> Tensor:  # [B, 4, 4] float32
    """From the (augmented) ego frame of another time to the batch's: A_t inv(G) G_other inv(A_t)."""
    aug = batch.aug_from_ego.double()
    ego_from_other = invert_rigid(batch.global_from_ego) @ other.global_from_ego
    return (aug @ ego_from_other @ torch.linalg.inv(other.aug_from_ego.double())).float()


def look_up_ranges(
    points: Array,  # [P, 3] m, above the road at z = 0
    origins: Array,  # [R, 3] m
    directions: Array,  # [R, 3] unit length
    max_range_m: float,
) -> Array:  # [R] m
    """How far each ray goes among points as wide as a beam: to the first near it, else to a flat road at z = 0.

    `max_range_m` where it meets neither: nothing is known to stand there.
    """
    found = np.full(len(origins), max_range_m)
    down = (directions[:, 2] < 0) & (origins[:, 2] > 0)
    found[down] = np.minimum(-origins[down, 2] / directions[down, 2], max_range_m)
    _, cell = np.unique(np.floor(origins / ORIGIN_CELL_M).astype(np.int64), axis=0, return_inverse=True)
    order = np.argsort(cell.ravel(), kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(cell.ravel()[order])) + 1) if len(order) else ():
        middle = origins[rows].mean(0)
        offsets = points - middle
        away = np.linalg.norm(offsets, axis=1)
        kept = np.flatnonzero(away > NEAR_M)
        met = _first_met(directions[rows], offsets[kept] / away[kept, None], away[kept])
        rows, met = rows[met >= 0], kept[met[met >= 0]]
        ends = offsets[met] + middle - origins[rows]
        found[rows] = np.clip((ends * directions[rows]).sum(1), 0.0, max_range_m)
    return found


def _first_met(
    directions: Array,  # [r, 3] unit length
    bearings: Array,  # [p, 3] unit length
    away: Array,  # [p] m
) -> Array:  # [r] int64, row of the point, -1 for none
    """Angles as chords, which are near enough."""
    found = np.full(len(directions), -1)
    axis = directions.mean(0) / max(np.linalg.norm(directions.mean(0)), 1e-9)
    widest = np.arccos(np.clip((directions @ axis).min(), -1, 1))
    aside = bearings @ axis
    for radius in RADII_RAD:
        rest = np.flatnonzero(found < 0)
        ahead = np.flatnonzero(aside >= np.cos(min(widest + radius, np.pi)) - 1e-12)
        ray, point, _ = neighbours_within(directions[rest], bearings[ahead], radius)
        nearest = np.lexsort((away[ahead[point]], ray))
        ray, first = np.unique(ray[nearest], return_index=True)
        found[rest[ray]] = ahead[point[nearest][first]]
    return found


def unseen(
    batch: FrameBatch,
    bounds: Bounds,
) -> Tensor:  # [R] bool
    """Rays of `batch.rays` that end in the bounds where no ray of the input, past frames included, ended or passed.

    Space is divided into cubes of CUBE_M. Raises ValueError for a batch without the origins of its LiDAR points
    (`data.lidar_origins`).
    """
    if batch.rays is None or batch.lidar_origins is None:
        raise ValueError("batch: what was seen follows from FrameBatch.lidar_origins; give data.lidar_origins=true")
    low, high = torch.tensor(bounds, dtype=torch.float32).unbind(1)
    shape = ((high - low) / CUBE_M).ceil().long().tolist()
    seen = torch.zeros(len(batch), *shape, dtype=torch.bool)
    for frame in (batch, *batch.past):
        matrix = aug_from_frame(batch, frame)[frame.lidar_batch]
        ends, starts = _moved(matrix, frame.lidar_points[:, :3]), _moved(matrix, frame.lidar_origins)
        owners, ranges = frame.lidar_batch.cpu(), (ends - starts).norm(dim=1)
        for distance in torch.arange(0, float(ranges.max()) if len(ranges) else 0.0, 0.5 * CUBE_M).tolist():
            rows = ranges > distance
            passed = starts[rows] + distance / ranges[rows, None] * (ends - starts)[rows]
            _mark(seen, passed, owners[rows.cpu()], low)
        _mark(seen, ends, owners, low)
    cells, inside = _cells(batch.rays.points, low, shape)
    found = torch.zeros(len(batch.rays), dtype=torch.bool)
    found[inside] = ~seen[batch.rays.batch.cpu()[inside], *cells[inside].unbind(1)]
    return found


def _mark(seen: Tensor, points: Tensor, owners: Tensor, low: Tensor) -> None:
    cells, inside = _cells(points, low, list(seen.shape[1:]))
    seen[owners[inside], *cells[inside].unbind(1)] = True


def _cells(points: Tensor, low: Tensor, shape: list[int]) -> tuple[Tensor, Tensor]:
    """Cell [n, 3] of each point and whether it is one of the grid [n], on the CPU."""
    cells = ((points.cpu() - low) / CUBE_M).floor().long()
    return cells, ((cells >= 0) & (cells < torch.tensor(shape))).all(1)


def _moved(matrices: Tensor, points: Tensor) -> Tensor:  # [n, 3]
    """Points [n, 3], each by a matrix [n, 4, 4] of its own."""
    return transform_points(matrices, points)  # not as a product, whose factors autocast would round
