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
    valid = {
        "samples": (_within(table.samples, 0, len(tokens)), f"0..{len(tokens) - 1}"),
        "labels": (_within(table.labels, 0, len(CLASSES)), f"0..{len(CLASSES) - 1}"),
        "attributes": (_within(table.attributes, -1, len(ATTRIBUTES)), f"-1..{len(ATTRIBUTES) - 1}"),
        "centers": (np.isfinite(table.centers), "finite"),
        "sizes": (np.isfinite(table.sizes) & (table.sizes > 0), "finite and positive"),
        "rotations": (np.isfinite(np.where(_all_zero(table.rotations), np.nan, table.rotations)), "finite, not all 0"),
        "velocities": (~np.isinf(table.velocities), "finite or NaN"),
        "scores": (np.isfinite(table.scores) & (table.scores >= 0), "finite and at least 0"),
    }
    for name, (right, expected) in valid.items():
        if right.all():
            continue
        row = int(np.argmin(right.reshape(len(table), -1).all(axis=1)))
        sample = int(table.samples[row])
        token = tokens[sample] if 0 <= sample < len(tokens) else "(none)"
        value = getattr(table, name)[row].tolist()
        raise DataError(f"prediction {row} (sample {token}): {name} must be {expected}, but got {value}")
    counts = np.bincount(table.samples, minlength=len(tokens))
    if len(table) and counts.max() > MAX_BOXES_PER_SAMPLE:
        worst = int(np.argmax(counts))
        raise DataError(
            f"sample {tokens[worst]}: at most {MAX_BOXES_PER_SAMPLE} boxes, but got {counts[worst]}; keep the best ones"
        )


def _within(
    values: Array,  # [n] int
    low: int,
    high: int,
) -> Array:
    return (values >= low) & (values < high)


def _all_zero(
    rotations: Array,  # [n, 4]
) -> Array:  # [n, 1] bool
    w, x, y, z = rotations.T
    return ((w == 0) & (x == 0) & (y == 0) & (z == 0))[:, None]
