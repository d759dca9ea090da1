"""Evaluation sets around ground truth, for tests."""

import numpy as np

from src.structures.detections import DetectionTable, EvaluationSet


def set_of(truth: DetectionTable, tokens=("a",), tags=(), **columns) -> EvaluationSet:
    """Samples at the origin, half a second apart in one scene, every box another object; `columns` say otherwise."""
    n = len(tokens)
    plain = {
        "ego_centers": np.zeros((n, 3)),
        "ego_rotations": np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        "scene_tags": [tags] * n,
        "racks": DetectionTable.empty(),
        "scenes": np.zeros(n, np.int64),
        "times_s": 0.5 * np.arange(n),
        "instances": np.arange(len(truth)),
    }
    return EvaluationSet(list(tokens), ground_truth=truth, **(plain | columns))
