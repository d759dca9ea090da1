"""The annotations of a split as the metric wants them."""

from __future__ import annotations

import numpy as np

from src.data.schema import LABEL_RACK, DatasetIndex
from src.data.splits import split_samples
from src.errors import DataError
from src.structures.detections import DetectionTable, EvaluationSet


def evaluation_set(index: DatasetIndex, split: str) -> EvaluationSet:
    """Samples in table order with ego positions, scene tags, ground truth before any filter, and bicycle racks.

    Raises DataError for a release without annotations.
    """
    if not index.annotated:
        raise DataError(f"{index.root / index.version}: no annotations, so nothing can be scored; choose another split")
    samples = split_samples(index, split)
    boxes = _rows(index, samples, index.box_labels >= 0)
    return EvaluationSet(
        tokens=[str(token) for token in index.sample_tokens[samples]],
        ego_centers=index.pose_translations[index.frame_poses[samples]],
        ego_rotations=index.pose_rotations[index.frame_poses[samples]],
        scene_tags=[tuple(str(index.scene_descriptions[scene]).split(";")) for scene in index.sample_scenes[samples]],
        ground_truth=_table(index, *boxes),
        racks=_table(index, *_rows(index, samples, index.box_labels == LABEL_RACK)),
        scenes=index.sample_scenes[samples].astype(np.int64),
        times_s=1e-6 * index.frame_times_us[samples],
        instances=index.box_instances[boxes[0]].astype(np.int64),
    )


def _rows(
    index: DatasetIndex,
    samples: np.ndarray,  # [n] ascending
    wanted: np.ndarray,  # [A] bool
) -> tuple[np.ndarray, np.ndarray]:  # [k] int64 rows of the boxes, [k] int64 place of each one's sample
    places = np.full(len(index), -1)
    places[samples] = np.arange(len(samples))
    owner = np.repeat(places, np.diff(index.box_starts))  # [A], -1 for boxes of other samples
    flat = np.flatnonzero(wanted & (owner >= 0))
    return flat, owner[flat]


def _table(
    index: DatasetIndex,
    flat: np.ndarray,  # [k] int64
    owner: np.ndarray,  # [k] int64
) -> DetectionTable:
    return DetectionTable(
        samples=owner.astype(np.int64),
        labels=np.maximum(index.box_labels[flat], 0).astype(np.int64),
        centers=index.box_centers[flat],
        sizes=index.box_sizes[flat],
        rotations=index.box_rotations[flat],
        velocities=index.box_velocities[flat][:, :2],
        attributes=index.box_attributes[flat].astype(np.int64),
        scores=np.zeros(len(flat)),
        num_points=index.box_points[flat].astype(np.int64),
    )
