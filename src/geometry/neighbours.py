"""Pairs of near points of two clouds, by sorted cells."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

Array = np.ndarray

MAX_PAIRS = 4_000_000
"""Candidates that are looked at together, which bounds the memory."""


def neighbours_within(
    queries: Array,  # [Q, D] float64
    points: Array,  # [P, D] float64
    radius: float,
) -> tuple[Array, Array, Array]:  # [n], [n] int64, [n]
    """Query, point and squared distance of every pair that is not further apart than `radius`."""
    found = list(_pairs(queries, points, radius))
    columns = zip(*found, strict=True) if found else ([np.zeros(0, np.int64)],) * 2 + ([np.zeros(0)],)
    query, point, squared = (np.concatenate(list(column)) for column in columns)
    return query, point, squared


def nearest_squared(
    queries: Array,  # [Q, D] float64
    points: Array,  # [P, D] float64, at least one
    first_radius: float = 0.5,
) -> Array:  # [Q] float64
    """Squared distance of every query to its nearest point, exact: the radius grows where nothing is found.

    Raises ValueError without a point and for coordinates that are not finite.
    """
    if not (len(points) and np.isfinite(queries).all() and np.isfinite(points).all()):
        raise ValueError(f"points must be at least one, but got {len(points)}, and all coordinates finite")
    best, radius = np.full(len(queries), np.inf), first_radius
    low, high = points.min(0), points.max(0)
    # Beyond the box around the points a smaller radius can find nothing.
    outside = np.linalg.norm(np.maximum(0.0, np.maximum(low - queries, queries - high)), axis=1)
    open_rows = np.arange(len(queries))
    while len(open_rows):
        tried = open_rows[outside[open_rows] <= radius]
        for query, _, squared in _pairs(queries[tried], points, radius):
            np.minimum.at(best, tried[query], squared)
        open_rows = open_rows[~np.isfinite(best[open_rows])]
        radius *= 4.0
    return best


def _pairs(queries: Array, points: Array, radius: float) -> Iterator[tuple[Array, Array, Array]]:
    if not (len(queries) and len(points)):
        return
    low = np.minimum(queries.min(0), points.min(0))
    cells, own = (((cloud - low) // radius).astype(np.int64) + 1 for cloud in (points, queries))
    sizes = np.maximum(cells.max(0), own.max(0)) + 2
    strides = np.concatenate([np.cumprod(sizes[:0:-1])[::-1], [1]])
    keys = cells @ strides
    order = np.argsort(keys, kind="stable")
    keys, own_keys = keys[order], own @ strides
    for shift in itertools.product((-1, 0, 1), repeat=queries.shape[1] - 1):
        row = own_keys + np.array([*shift, 0]) @ strides  # with its two neighbours along the last axis
        starts, ends = np.searchsorted(keys, row - 1), np.searchsorted(keys, row + 1, "right")
        counts = ends - starts
        some = np.flatnonzero(counts)
        for part in np.split(some, np.flatnonzero(np.diff(np.cumsum(counts[some]) // MAX_PAIRS)) + 1):
            query = np.repeat(part, counts[part])
            within = np.arange(len(query)) - np.repeat(np.cumsum(counts[part]) - counts[part], counts[part])
            point = order[starts[query] + within]
            squared = ((queries[query] - points[point]) ** 2).sum(1)
            kept = squared <= radius * radius
            yield query[kept], point[kept], squared[kept]
