"""What a detector's inner state has to do with the truth: Gaussians beside objects, and what each object is seen by.

These are no scores: they say why a memory, a margin or a sampling rule gives what it gives. They read the `Evidence`
that a model offers, so a model that offers none has those alone that the input decides.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.geometry.box_cells import cells_in_boxes
from src.geometry.box_distance import count_points_in_boxes, footprint_distances
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from src.structures.detections import EvaluationSet
from src.structures.evidence import Evidence
from src.structures.gaussians import GaussianSet
from src.structures.taxonomy import Source

Array = np.ndarray

NEAR_M = 2.4
"""A Gaussian is near an object, and covers it, when its mean lies no further from the box's footprint: half of the
paper's margin of 4.8 m (Table 12), on each side."""
FAINT_OPACITY = 0.1
"""A Gaussian of less opacity hardly says anything."""
FAST_MPS = 10.0
"""From here on matter moves fast enough for a wrong velocity to cost more than a cell in a frame."""
SEEN_POINTS = 3
"""An object with fewer returns in the accumulated input is hardly seen."""
SEEN_S = 4.1
"""How long before it must have been seen to be remembered: eight key frames, whose times jitter by milliseconds."""
UNKNOWN_POINTS = -1
COVERS = {
    Source.RADAR: "radar_covers",
    Source.CAMERA: "camera_covers",
    Source.RANDOM: "random_covers",
    Source.HISTORY: "remembered_share",
}
"""Measures of the share of objects that Gaussians of a source cover."""


@dataclass
class FrameDiagnosis:
    """Of one sample, on the CPU; boxes in the order of its annotations, None for what the model does not offer."""

    points: Array  # [k] int64, returns inside each box of all that the model reads, accumulated sweeps included
    occupied: Array | None  # [k] bool, an occupied cell lies inside the box
    head: Array | None  # [k] bool, a cell that the head sees does
    covered: Array | None  # [k, 4] bool, a Gaussian of each `Source` covers it
    sums: dict[str, tuple[float, float]]  # total and count of each mean over Gaussians


def diagnose(
    evidence: Evidence,
    batch: FrameBatch,
    truth: list[Boxes3D],  # B, aug frame
) -> list[FrameDiagnosis]:
    """Compare what a batch's samples were made of with their annotations."""
    found = []
    for sample, boxes in enumerate(boxes.to(batch.device) for boxes in truth):
        occupied = head = covered = None
        sums: dict[str, tuple[float, float]] = {}
        if evidence.cells is not None:
            splatted = evidence.cells
            occupied = _hold_cells(splatted.indices[splatted.occupied], splatted.grid, sample, boxes)
        if evidence.head_cells is not None:
            head = _hold_cells(evidence.head_cells.indices, evidence.head_cells.grid, sample, boxes)
        if evidence.gaussians is not None:
            covered, sums = _compare_gaussians(evidence.gaussians, sample, boxes)
        found.append(FrameDiagnosis(count_returns(batch, sample, boxes), occupied, head, covered, sums))
    return found


def sums_by_sample(
    diagnoses: Mapping[int, FrameDiagnosis],  # by row of the set's tokens
    evaluation_set: EvaluationSet,
    truth_kept: Array,  # [k] bool, ground truth that counts
    found: Array,  # [k] bool, ground truth that is matched at 2 m
) -> dict[str, Array]:  # [S, 2] each
    """Total and count of every measure in each sample; the measure is the ratio of their sums, see `ratios`.

    `hidden_recall`: share that is found, at whatever score, of the objects that hide but were seen before (`hidden`);
    `occupied_share`: share of the objects with an occupied cell inside; `head_share`: with a cell that the head sees,
    those of the radar and of memory among them; `<source>_covers`, of history `remembered_share`: that a Gaussian
    covers. Of all these only ground truth that counts.
    `<source>_gaussians`: how many a frame has; `<source>_near`: share of them near an object; `<source>_faint`: share
    below FAINT_OPACITY; `<source>_velocity_error`: m/s, of those inside a box that moves at FAST_MPS or faster, to its
    velocity, and `<source>_radial_error` what of it lies along the ray from the vehicle, which a radar measures; the
    sources are those of `Source`.
    """
    truth, num_samples = evaluation_set.ground_truth, len(evaluation_set.tokens)
    points = np.full(len(truth), UNKNOWN_POINTS)
    occupied = np.full(len(truth), np.nan)  # 0 or 1, NaN where not known, as the next two
    head = np.full(len(truth), np.nan)
    covered = np.full((len(truth), len(COVERS)), np.nan)
    of_gaussians: dict[str, Array] = {}
    for sample, diagnosis in diagnoses.items():
        rows = np.flatnonzero(truth.samples == sample)
        points[rows] = diagnosis.points
        for column, values in ((occupied, diagnosis.occupied), (head, diagnosis.head), (covered, diagnosis.covered)):
            if values is not None:
                column[rows] = values
        for name, sums in diagnosis.sums.items():
            of_gaussians.setdefault(name, np.zeros((num_samples, 2)))[sample] = sums

    def of_objects(total: Array, among: Array) -> Array:  # [k] bool each -> [S, 2]
        columns = (total & among & truth_kept, among & truth_kept)
        return np.stack([np.bincount(truth.samples[rows], minlength=num_samples) for rows in columns], axis=1)

    sums: dict[str, Array] = {}
    if diagnoses:
        sums["hidden_recall"] = of_objects(found, hidden(points, evaluation_set))
    for name, held in (("occupied_share", occupied), ("head_share", head)):
        if not np.isnan(held).all():
            sums[name] = of_objects(held == 1, ~np.isnan(held))
    for source, name in COVERS.items():
        how_many = of_gaussians.get(f"{source.name.lower()}_gaussians")
        if how_many is not None and how_many[:, 0].any():
            sums[name] = of_objects(covered[:, source] == 1, ~np.isnan(covered[:, source]))
    return sums | dict(sorted(of_gaussians.items()))


def hidden(
    points: Array,  # [k] int64, returns inside each box of the ground truth, UNKNOWN_POINTS where not counted
    evaluation_set: EvaluationSet,
) -> Array:  # [k] bool
    """Objects with fewer than SEEN_POINTS returns now, but as many or more at an earlier key frame within SEEN_S."""
    times_s = evaluation_set.times_s[evaluation_set.ground_truth.samples]
    seen = seen_before(points >= SEEN_POINTS, evaluation_set.instances, times_s)
    return seen & (points < SEEN_POINTS) & (points != UNKNOWN_POINTS)


def seen_before(
    hit: Array,  # [k] bool
    instances: Array,  # [k] int64
    times_s: Array,  # [k]
) -> Array:  # [k] bool
    """Which rows come within SEEN_S after another of the same instance that is hit; rows in any order."""
    order = np.lexsort((times_s, instances))
    rank = np.arange(len(order))
    starts = np.diff(instances[order], prepend=-1) != 0
    first = np.maximum.accumulate(np.where(starts, rank, 0))  # of the same object
    last_hit = np.maximum.accumulate(np.where(hit[order], rank, -1))
    before = np.concatenate([[-1], last_hit[:-1]]) if len(order) else last_hit
    known = before >= first
    recent = times_s[order] - times_s[order][np.where(known, before, 0)] <= SEEN_S
    result = np.zeros(len(order), bool)
    result[order] = known & recent
    return result


def ratios(
    sums: Mapping[str, Array],  # [S, 2] each
    weights: Array,  # [R, S] how often each sample counts
) -> dict[str, Array]:  # [R] each
    """Sum of the totals over that of the counts, NaN where there is nothing to count."""
    found = {}
    for name, of_samples in sums.items():
        total, count = (weights @ of_samples).T
        found[name] = np.divide(total, count, out=np.full(len(weights), np.nan), where=count > 0)
    return found


def count_returns(batch: FrameBatch, sample: int, boxes: Boxes3D) -> Array:  # [k] int64
    """Points of the sample's radar and LiDAR input inside each of its boxes."""
    half = 0.5 * boxes.sizes[:, 2]
    heights = torch.stack([boxes.centers[:, 2] - half, boxes.centers[:, 2] + half], dim=1)
    counts = torch.zeros(len(boxes), dtype=torch.int64, device=boxes.centers.device)
    for points, owners in ((batch.radar_points, batch.radar_batch), (batch.lidar_points, batch.lidar_batch)):
        if points is not None:
            counts += count_points_in_boxes(points[owners == sample, :3], boxes.bev(), heights)
    return counts.cpu().numpy()


def _hold_cells(
    indices: Tensor,  # [n, 3] int64 (sample, row, col)
    grid: BEVGrid,
    sample: int,
    boxes: Boxes3D,
) -> Array:  # [k] bool
    row, col = indices[indices[:, 0] == sample, 1:].unbind(1)
    box, cell, _ = cells_in_boxes(boxes.bev(), grid)
    held = torch.zeros(len(boxes), dtype=torch.bool, device=box.device)
    held[box[torch.isin(cell, row * grid.cols + col)]] = True
    return held.cpu().numpy()


def _compare_gaussians(
    gaussians: GaussianSet, sample: int, boxes: Boxes3D
) -> tuple[Array, dict[str, tuple[float, float]]]:
    """`FrameDiagnosis.covered` and `FrameDiagnosis.sums`."""
    valid = gaussians.valid[sample]
    means, sources = gaussians.means[sample][valid].float(), gaussians.sources[sample][valid]
    distances = footprint_distances(means, boxes.bev())  # [g, k]
    near = (distances <= NEAR_M).any(dim=1)
    faint = gaussians.opacity_logits[sample][valid].sigmoid() < FAINT_OPACITY
    errors = _velocity_errors(gaussians.velocities[sample][valid].float(), means, distances, boxes)
    sums: dict[str, tuple[float, float]] = {}
    for source in Source:
        own = sources == source
        count = int(own.sum())
        name, wrong = source.name.lower(), errors[own & ~errors.isnan().any(dim=1)]
        sums[f"{name}_gaussians"] = (count, 1)
        sums[f"{name}_near"] = (int(near[own].sum()), count)
        sums[f"{name}_faint"] = (int(faint[own].sum()), count)
        for kind, total in zip(("velocity", "radial"), wrong.sum(dim=0).tolist(), strict=True):
            sums[f"{name}_{kind}_error"] = (total, len(wrong))
    covered = torch.stack([(distances[sources == source] <= NEAR_M).any(dim=0) for source in COVERS], dim=1)
    return covered.cpu().numpy(), sums


def _velocity_errors(
    velocities: Tensor,  # [g, 2] m/s
    means: Tensor,  # [g, 2] m, from the vehicle
    distances: Tensor,  # [g, k] m
    boxes: Boxes3D,
) -> Tensor:  # [g, 2] m/s, whole and its part along the ray
    """Of Gaussians within a fast box to its velocity; NaN elsewhere, where what stands beside the road may be meant."""
    if not len(boxes):
        return velocities.new_full((len(velocities), 2), torch.nan)
    nearest, box = distances.min(dim=1)
    wrong = velocities - boxes.velocities[box]
    errors = torch.stack([wrong.norm(dim=1), (wrong * F.normalize(means, dim=1)).sum(dim=1).abs()], dim=1)
    counted = (nearest == 0) & (boxes.velocities[box].norm(dim=1) >= FAST_MPS)
    return torch.where(counted[:, None], errors, torch.nan)
