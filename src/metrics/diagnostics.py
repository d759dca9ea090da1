"""What a detector's inner state has to do with the truth: Gaussians beside objects, and what each object is seen by.

These are no scores: they say why a memory, a margin or a sampling rule gives what it gives. They read the `Evidence`
that a model offers, so a model that offers none has those alone that the input decides.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from src.geometry.box_cells import cells_in_boxes
from src.geometry.box_distance import count_points_in_boxes, footprint_distances
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from src.structures.detections import EvaluationSet
from src.structures.evidence import Evidence, SplattedCells
from src.structures.gaussians import GaussianSet, Source

Array = np.ndarray

NEAR_M = 2.4
"""A Gaussian is near an object, and covers it, when its mean lies no further from the box's footprint: half of the
paper's margin of 4.8 m (Table 12), on each side."""
FAINT_OPACITY = 0.1
"""A Gaussian of less opacity hardly says anything."""
FAST_MPS = 10.0
"""From here on matter moves fast enough for a wrong velocity to cost more than a cell in a frame."""


@dataclass
class FrameDiagnosis:
    """Of one sample, on the CPU; boxes in the order of its annotations, None for what the model does not offer."""

    points: Array  # [k] int64, returns inside each box of all that the model reads, accumulated sweeps included
    occupied: Array | None  # [k] bool, an occupied cell lies inside the box
    remembered: Array | None  # [k] bool, a remembered Gaussian covers it
    sums: dict[str, tuple[float, float]]  # total and count of each mean over Gaussians


def diagnose(evidence: Evidence, batch: FrameBatch) -> list[FrameDiagnosis]:
    """Compare what a batch's samples were made of with their annotations. Raises ValueError for a batch without."""
    if batch.boxes is None:
        raise ValueError("FrameBatch.boxes is None: without annotations there is nothing to compare with")
    found = []
    for sample, boxes in enumerate(batch.boxes):
        occupied = None if evidence.cells is None else _hold_occupied_cells(evidence.cells, sample, boxes)
        remembered, sums = None, {}
        if evidence.gaussians is not None:
            remembered, sums = _compare_gaussians(evidence.gaussians, sample, boxes)
        found.append(FrameDiagnosis(_count_returns(batch, sample, boxes), occupied, remembered, sums))
    return found


def sums_by_sample(
    diagnoses: Mapping[int, FrameDiagnosis],  # by row of the set's tokens
    evaluation_set: EvaluationSet,
    truth_kept: Array,  # [k] bool, ground truth that counts
) -> dict[str, Array]:  # [S, 2] each
    """Total and count of every measure in each sample; the measure is the ratio of their sums, see `measures_of`.

    `<source>_gaussians`: how many a frame has; `<source>_near`: share of them near an object; `<source>_faint`: share
    below FAINT_OPACITY; `<source>_velocity_error`: m/s, of those near a box that moves faster than FAST_MPS, to its
    velocity; the sources are those of `Source`. `remembered_objects`: share of the objects that count which a
    remembered Gaussian covers; a model that remembers none throughout has no such number.
    Raises ValueError when a sample's boxes are not those of the set.
    """
    num_samples, samples = len(evaluation_set.tokens), evaluation_set.ground_truth.samples
    names = {name for diagnosis in diagnoses.values() for name in diagnosis.sums}
    found = {name: np.zeros((num_samples, 2)) for name in sorted(names)}
    remembered = np.zeros((num_samples, 2))
    for sample, diagnosis in diagnoses.items():
        kept = truth_kept[samples == sample]
        if len(kept) != len(diagnosis.points):
            raise ValueError(
                f"sample {evaluation_set.tokens[sample]}: {len(diagnosis.points)} boxes in its batch, but {len(kept)} "
                "in the evaluation set"
            )
        for name, sums in diagnosis.sums.items():
            found[name][sample] = sums
        if diagnosis.remembered is not None:
            remembered[sample] = diagnosis.remembered[kept].sum(), kept.sum()
    if remembered[:, 0].any():
        found["remembered_objects"] = remembered
    return found


def measures_of(sums: Mapping[str, Array]) -> dict[str, float | None]:
    """Ratio of the totals and counts [S, 2] of all samples by name, None where there is nothing to count."""
    totals = {name: of_samples.sum(axis=0) for name, of_samples in sums.items()}
    return {name: float(total / count) if count else None for name, (total, count) in totals.items()}


def _count_returns(batch: FrameBatch, sample: int, boxes: Boxes3D) -> Array:  # [k] int64
    half = 0.5 * boxes.sizes[:, 2]
    heights = torch.stack([boxes.centers[:, 2] - half, boxes.centers[:, 2] + half], dim=1)
    counts = torch.zeros(len(boxes), dtype=torch.int64, device=boxes.centers.device)
    for points, owners in ((batch.radar_points, batch.radar_batch), (batch.lidar_points, batch.lidar_batch)):
        if points is not None:
            counts += count_points_in_boxes(points[owners == sample, :3], boxes.bev(), heights)
    return counts.cpu().numpy()


def _hold_occupied_cells(cells: SplattedCells, sample: int, boxes: Boxes3D) -> Array:  # [k] bool
    row, col = cells.indices[cells.occupied & (cells.indices[:, 0] == sample), 1:].unbind(1)
    box, cell, _ = cells_in_boxes(boxes.bev(), cells.grid)
    held = torch.zeros(len(boxes), dtype=torch.bool, device=box.device)
    held[box[torch.isin(cell, row * cells.grid.cols + col)]] = True
    return held.cpu().numpy()


def _compare_gaussians(
    gaussians: GaussianSet, sample: int, boxes: Boxes3D
) -> tuple[Array, dict[str, tuple[float, float]]]:
    """Which boxes the remembered Gaussians cover, and `FrameDiagnosis.sums`."""
    valid = gaussians.valid[sample]
    means, sources = gaussians.means[sample][valid].float(), gaussians.sources[sample][valid]
    distances = footprint_distances(means, boxes.bev())  # [g, k]
    near = (distances <= NEAR_M).any(dim=1)
    faint = gaussians.opacity_logits[sample][valid].sigmoid() < FAINT_OPACITY
    errors = _velocity_errors(gaussians.velocities[sample][valid].float(), distances, boxes)
    sums: dict[str, tuple[float, float]] = {}
    for source in Source:
        own = sources == source
        count = int(own.sum())
        name, wrong = source.name.lower(), errors[own][~errors[own].isnan()]
        sums[f"{name}_gaussians"] = (count, 1)
        sums[f"{name}_near"] = (int(near[own].sum()), count)
        sums[f"{name}_faint"] = (int(faint[own].sum()), count)
        sums[f"{name}_velocity_error"] = (float(wrong.sum()), len(wrong))
    remembered = (distances[sources == Source.HISTORY] <= NEAR_M).any(dim=0)
    return remembered.cpu().numpy(), sums


def _velocity_errors(
    velocities: Tensor,  # [g, 2] m/s
    distances: Tensor,  # [g, k] m
    boxes: Boxes3D,
) -> Tensor:  # [g] m/s
    """Of Gaussians to the velocity of the nearest box; NaN unless it is near and moves fast."""
    if not len(boxes):
        return velocities.new_full((len(velocities),), torch.nan)
    nearest, box = distances.min(dim=1)
    errors = (velocities - boxes.velocities[box]).norm(dim=1)
    counted = (nearest <= NEAR_M) & (boxes.velocities[box].norm(dim=1) > FAST_MPS)
    return torch.where(counted, errors, torch.nan)
