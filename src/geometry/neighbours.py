"""Pairs of near points of two clouds, by sorted cells."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

Array = np.ndarray

RADII = (0.5, 2.0)
"""In which the nearest point is looked for first."""
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
) -> Array:  # [Q] float64
    """Squared distance of every query to its nearest point, exact: first those with one within RADII, by cells,
    then the rest against all.

    Raises ValueError without a point and for coordinates that are not finite.
    """
    if not (len(points) and np.isfinite(queries).all() and np.isfinite(points).all()):
        raise ValueError(f"points must be at least one, but got {len(points)}, and all coordinates finite")
    best, rest = np.full(len(queries), np.inf), np.arange(len(queries))
    for radius in RADII:
        for query, _, squared in _pairs(queries[rest], points, radius):
            np.minimum.at(best, rest[query], squared)
        rest = rest[np.isinf(best[rest])]
    lengths = 0.5 * (points**2).sum(1)
    for part in np.array_split(rest, len(rest) * len(points) // MAX_PAIRS + 1):
        nearest = np.argmin(lengths - queries[part] @ points.T, axis=1)
        best[part] = ((queries[part] - points[nearest]) ** 2).sum(1)
    return best


def expand_ranges(
    starts: Array,  # [q] int
    ends: Array,  # [q] int, at least starts
) -> tuple[Array, Array]:
    """Every (q, i) with starts[q] <= i < ends[q], in order: two arrays [p] int64."""
    counts = (ends - starts).astype(np.int64)
    rows = np.repeat(np.arange(len(counts)), counts)
    before = np.cumsum(counts) - counts
    return rows, np.arange(len(rows)) + (starts - before)[rows]


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
    along = np.argsort(own_keys)  # look-ups in order find the keys in the cache
    own_keys = own_keys[along]
    for shift in itertools.product((-1, 0, 1), repeat=queries.shape[1] - 1):
        row = own_keys + np.array([*shift, 0]) @ strides  # with its two neighbours along the last axis
        starts, ends = np.searchsorted(keys, row - 1), np.searchsorted(keys, row + 1, "right")
        counts = ends - starts
        some = np.flatnonzero(counts)
        for part in np.split(some, np.flatnonzero(np.diff(np.cumsum(counts[some]) // MAX_PAIRS)) + 1):
            rows, places = expand_ranges(starts[part], ends[part])
            point, query = order[places], along[part[rows]]
            squared = ((queries[query] - points[point]) ** 2).sum(1)
            kept = squared <= radius * radius
            yield query[kept], point[kept], squared[kept]
