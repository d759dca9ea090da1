"""Validity checks on a table of predictions before it is scored or written."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from src.errors import DataError
from src.structures.detections import DetectionTable
from src.structures.taxonomy import ATTRIBUTES, CLASSES, MAX_BOXES_PER_SAMPLE

Array = np.ndarray

LARGEST = 1e9
"""Of any number in size: beyond it, squares and differences lose their meaning long before they overflow."""
SMALLEST_ROTATION = 1e-100
"""Of a quaternion's largest entry: the square of a smaller one is 0, and so is its length."""
_FINITE = f"finite, at most {LARGEST:g} in size"


def check_predictions(table: DetectionTable, tokens: Sequence[str]) -> None:
    """Refuse predictions that the official evaluator refuses, or would score with no meaning.

    Refused: indices outside the samples, classes or attributes; numbers that are not finite or beyond LARGEST (only a
    velocity may be NaN); sizes that are not positive; a rotation of all zeros; negative scores; more than 500 boxes of
    one sample.

    Raises DataError naming the sample, the box (counted within the table) and the value.
    """

    def within(values: Array, low: int, high: int) -> Array:  # [n] int -> [n] bool
        return (values >= low) & (values < high)

    valid = {
        "samples": (within(table.samples, 0, len(tokens)), f"0..{len(tokens) - 1}"),
        "labels": (within(table.labels, 0, len(CLASSES)), f"0..{len(CLASSES) - 1}"),
        "attributes": (within(table.attributes, -1, len(ATTRIBUTES)), f"-1..{len(ATTRIBUTES) - 1}"),
        "centers": (np.abs(table.centers) <= LARGEST, _FINITE),
        "sizes": ((table.sizes > 0) & (table.sizes <= LARGEST), f"positive and {_FINITE}"),
        "rotations": (_are_rotations(table.rotations), f"{_FINITE}, not all 0"),
        "velocities": (~(np.abs(table.velocities) > LARGEST), f"{_FINITE}, or NaN"),
        "scores": ((table.scores >= 0) & (table.scores <= LARGEST), f"at least 0 and {_FINITE}"),
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


def _are_rotations(
    rotations: Array,  # [n, 4]
) -> Array:  # [n, 4] bool
    possible = np.abs(rotations) <= LARGEST  # False for NaN too
    length = np.abs(np.where(possible, rotations, 0.0)).max(axis=1, initial=0.0)
    return possible & (length >= SMALLEST_ROTATION)[:, None]
