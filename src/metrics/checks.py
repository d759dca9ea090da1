"""What a table of predictions must be before it is scored or written."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from src.errors import DataError
from src.structures.detections import DetectionTable
from src.structures.taxonomy import ATTRIBUTES, CLASSES, MAX_BOXES_PER_SAMPLE

Array = np.ndarray


def check_predictions(table: DetectionTable, tokens: Sequence[str]) -> None:
    """Refuse predictions that the official evaluator refuses, or would score with no meaning.

    Refused: indices outside the samples, classes or attributes; numbers that are not finite (only a velocity may be
    NaN); sizes that are not positive; a rotation of all zeros; negative scores; more than 500 boxes of one sample.

    Raises DataError naming the sample, the box (counted within the table) and the value.
    """
    faults = {
        "sample index": (table.samples, (table.samples < 0) | (table.samples >= len(tokens)), f"0..{len(tokens) - 1}"),
        "label": (table.labels, (table.labels < 0) | (table.labels >= len(CLASSES)), f"0..{len(CLASSES) - 1}"),
        "attribute": (
            table.attributes,
            (table.attributes < -1) | (table.attributes >= len(ATTRIBUTES)),
            f"-1..{len(ATTRIBUTES) - 1}",
        ),
        "center": (table.centers, ~np.isfinite(table.centers).all(axis=1), "finite"),
        "size": (table.sizes, ~_all_positive(table.sizes), "finite and positive"),
        "rotation": (table.rotations, ~_is_direction(table.rotations), "finite and not all zero"),
        "velocity": (table.velocities, np.isinf(table.velocities).any(axis=1), "finite or NaN"),
        "score": (table.scores, ~(np.isfinite(table.scores) & (table.scores >= 0)), "finite and at least 0"),
    }
    for name, (values, wrong, expected) in faults.items():
        if wrong.any():
            row = int(np.argmax(wrong))
            sample = int(table.samples[row])
            token = tokens[sample] if 0 <= sample < len(tokens) else "(none)"
            raise DataError(
                f"prediction {row} (sample {token}): {name} must be {expected}, but got {values[row].tolist()}"
            )
    counts = np.bincount(table.samples, minlength=len(tokens))
    if len(table) and counts.max() > MAX_BOXES_PER_SAMPLE:
        worst = int(np.argmax(counts))
        raise DataError(
            f"sample {tokens[worst]}: at most {MAX_BOXES_PER_SAMPLE} boxes, but got {counts[worst]}; keep the best ones"
        )


def _all_positive(
    sizes: Array,  # [n, 3]
) -> Array:
    return (np.isfinite(sizes) & (sizes > 0)).all(axis=1)


def _is_direction(
    rotations: Array,  # [n, 4]
) -> Array:
    return np.isfinite(rotations).all(axis=1) & (rotations != 0).any(axis=1)
