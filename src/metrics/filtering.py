"""What decides which boxes a detection score counts: distance, class range, points, bicycle racks."""

from __future__ import annotations

import numpy as np

from src.geometry.neighbours import expand_ranges
from src.geometry.transforms import quaternion_to_matrix
from src.structures.detections import DetectionTable, EvaluationSet
from src.structures.taxonomy import CLASSES

Array = np.ndarray

SPEED_CLASSES_MPS = {"0-0.5": 0.0, "0.5-10": 0.5, "10-25": 10.0, "25+": 25.0}
"""Our speed classes, by name the speed at which each begins (it belongs to the class). Not part of the devkit."""

UNKNOWN_SPEED = -1

_CYCLES = (CLASSES.index("bicycle"), CLASSES.index("motorcycle"))


def ego_distances(evaluation_set: EvaluationSet, table: DetectionTable) -> Array:
    """Distance in the ground plane from each box to the ego of its sample: [n] metres."""
    ego = evaluation_set.ego_centers
    x = table.centers[:, 0] - ego[table.samples, 0]
    y = table.centers[:, 1] - ego[table.samples, 1]
    return np.sqrt(x * x + y * y)


def has_points_and_no_rack(
    evaluation_set: EvaluationSet,
    table: DetectionTable,
    near: Array,  # [n] bool
) -> Array:
    """Those of the near boxes that are not without points and no cycle inside a bicycle rack, [n] bool."""
    kept = near & (table.num_points != 0)
    if len(evaluation_set.racks):
        cycles = np.flatnonzero(kept & np.isin(table.labels, _CYCLES))
        kept[cycles[_inside_rack(table[cycles], evaluation_set.racks)]] = False
    return kept


def speed_classes(
    velocities: Array,  # [n, 2] m/s, NaN where unknown
) -> Array:
    """Place in SPEED_CLASSES_MPS of each box, UNKNOWN_SPEED where the velocity is NaN: [n] int64."""
    speeds = np.sqrt(np.vecdot(velocities, velocities))
    places = np.digitize(speeds, list(SPEED_CLASSES_MPS.values())) - 1
    return np.where(np.isnan(speeds), UNKNOWN_SPEED, places)


def _inside_rack(boxes: DetectionTable, racks: DetectionTable) -> Array:
    """Whether each box's centre lies in a rack of its sample, borders included: [n] bool.

    A rack is spanned by three edges from its front left top corner; a point is inside where its projection on each
    edge falls between the edge's ends. Summing in the official order keeps points on a border on the same side.
    """
    order = np.argsort(racks.samples, kind="stable")
    bounds = (np.searchsorted(racks.samples[order], boxes.samples, side) for side in ("left", "right"))
    pairs_box, pairs_rack = expand_ranges(*bounds)
    rack = racks[order[pairs_rack]]
    width, length, height = rack.sizes.T
    axes = quaternion_to_matrix(rack.rotations)  # [p, 3, 3]
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
