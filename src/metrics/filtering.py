"""Which boxes the official evaluation counts: class range, points, bicycle racks."""

from __future__ import annotations

import numpy as np

from src.structures.detections import DetectionTable, EvaluationSet
from src.structures.taxonomy import CLASS_RANGE_M, CLASSES

Array = np.ndarray

RANGE_BINS_M = ((0.0, 25.0), (25.0, 50.0), (50.0, 100.0), (100.0, 150.0))
"""Our distance bins [low, high): after the official filters, each box by its own distance. Not part of the devkit."""

_CYCLES = (CLASSES.index("bicycle"), CLASSES.index("motorcycle"))


def ego_distances(evaluation_set: EvaluationSet, table: DetectionTable) -> Array:
    """Distance in the ground plane from each box to the ego of its sample: [n] metres."""
    return np.sqrt(np.square(ego_offsets(evaluation_set, table)).sum(axis=1))


def ego_offsets(evaluation_set: EvaluationSet, table: DetectionTable) -> Array:
    """Box centre minus ego position of its sample, global axes: [n, 2] metres."""
    return table.centers[:, :2] - evaluation_set.ego_centers[table.samples, :2]


def official_filter(
    evaluation_set: EvaluationSet,
    table: DetectionTable,
    distances: Array,  # [n] m, from ego_distances
) -> Array:
    """Boxes that count, [n] bool: nearer than the class range, not without points, no cycle inside a bicycle rack.

    The same filters apply to ground truth and predictions; a prediction that states 0 points is dropped too.
    """
    class_range_m = np.array([CLASS_RANGE_M[name] for name in CLASSES])
    kept = (distances < class_range_m[table.labels]) & (table.num_points != 0)
    if len(evaluation_set.racks):
        cycles = np.flatnonzero(kept & np.isin(table.labels, _CYCLES))
        kept[cycles[_inside_rack(table[cycles], evaluation_set.racks)]] = False
    return kept


def _inside_rack(boxes: DetectionTable, racks: DetectionTable) -> Array:
    """Whether each box's centre lies in a rack of its sample, borders included: [n] bool.

    A rack is spanned by three edges from its front left top corner; a point is inside where its projection on each
    edge falls between the edge's ends. Summing in the official order keeps points on a border on the same side.
    """
    order = np.argsort(racks.samples, kind="stable")
    pairs_box, pairs_rack = join_sorted(boxes.samples, racks.samples[order])
    rack = racks[order[pairs_rack]]
    width, length, height = rack.sizes.T
    axes = rotation_matrices(rack.rotations)  # [p, 3, 3]
    half = np.stack([length, width, height], axis=1) / 2
    signs = {"corner": (1, 1, 1), "x": (-1, 1, 1), "y": (1, -1, 1), "z": (1, 1, -1)}
    corners = {name: np.einsum("pij,pj->pi", axes, half * sign) + rack.centers for name, sign in signs.items()}
    offset = boxes.centers[pairs_box] - corners["corner"]
    inside = np.ones(len(pairs_box), dtype=bool)
    for name in ("x", "y", "z"):
        edge = corners[name] - corners["corner"]
        along = np.vecdot(edge, offset)
        inside &= (along >= 0) & (along <= np.vecdot(edge, edge))
    result = np.zeros(len(boxes), dtype=bool)
    result[pairs_box[inside]] = True
    return result


def join_sorted(
    queries: Array,  # [q] int
    keys: Array,  # [k] int, ascending
) -> tuple[Array, Array]:
    """All pairs (row of `queries`, row of `keys`) with equal values, ordered by both: two arrays [p] int64."""
    return expand_ranges(np.searchsorted(keys, queries, "left"), np.searchsorted(keys, queries, "right"))


def expand_ranges(
    starts: Array,  # [q] int
    ends: Array,  # [q] int, at least starts
) -> tuple[Array, Array]:
    """Every (q, i) with starts[q] <= i < ends[q], in order: two arrays [p] int64."""
    counts = (ends - starts).astype(np.int64)
    rows = np.repeat(np.arange(len(counts)), counts)
    before = np.cumsum(counts) - counts
    return rows, np.arange(len(rows)) + (starts - before)[rows]


def rotation_matrices(
    quaternions: Array,  # [n, 4] (w, x, y, z), any non-zero length
) -> Array:
    """Rotation matrices [n, 3, 3] of quaternions, which are normalised first; all zeros where the quaternion is."""
    norms = np.linalg.norm(quaternions, axis=1, keepdims=True)
    w, x, y, z = (quaternions / np.where(norms > 0, norms, 1.0)).T
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return np.array(rows).reshape(3, 3, -1).transpose(2, 0, 1)
