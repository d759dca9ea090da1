"""The recorded case of the official evaluator, as our structures."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from src.structures.detections import DetectionTable, EvaluationSet
from src.structures.taxonomy import ATTRIBUTES, CLASSES

GOLDEN = Path(__file__).parents[1] / "golden" / "truckscenes_eval" / "public_medium.json"


def table_of(boxes_by_token: dict[str, list[dict]], tokens: list[str]) -> DetectionTable:
    rows = [(sample, box) for sample, token in enumerate(tokens) for box in boxes_by_token[token]]
    boxes = [box for _, box in rows]
    attributes = [box.get("attribute_name", "") for box in boxes]
    velocities = [box.get("velocity", [0.0, 0.0]) for box in boxes]
    return DetectionTable(
        samples=np.array([sample for sample, _ in rows]),
        labels=np.array([CLASSES.index(box.get("detection_name", CLASSES[0])) for box in boxes]),
        centers=np.array([box["translation"] for box in boxes], dtype=float),
        sizes=np.array([box["size"] for box in boxes], dtype=float),
        rotations=np.array([box["rotation"] for box in boxes], dtype=float),
        velocities=np.array([[math.nan if v is None else v for v in pair] for pair in velocities]),
        attributes=np.array([ATTRIBUTES.index(name) if name else -1 for name in attributes]),
        scores=np.array([box.get("detection_score", 0.0) for box in boxes]),
        num_points=np.array([box.get("num_pts", -1) for box in boxes]),
    )


@pytest.fixture(scope="session")
def golden() -> dict:
    return json.loads(GOLDEN.read_text())


@pytest.fixture(scope="session")
def golden_set(golden) -> EvaluationSet:
    tokens = [sample["token"] for sample in golden["samples"]]
    return EvaluationSet(
        tokens=tokens,
        ego_centers=np.array([sample["ego_translation"] for sample in golden["samples"]]),
        ego_rotations=np.tile([1.0, 0.0, 0.0, 0.0], (len(tokens), 1)),
        scene_tags=[tuple(sample["scene_description"].split(";")) for sample in golden["samples"]],
        ground_truth=table_of(golden["gt"], tokens),
        racks=table_of(golden["bicycle_racks"], tokens),
        scenes=np.arange(len(tokens)) // 5,
        times_s=0.5 * np.arange(len(tokens)),
        instances=np.arange(sum(map(len, golden["gt"].values()))),
    )


@pytest.fixture(scope="session")
def golden_predictions(golden, golden_set) -> DetectionTable:
    return table_of(golden["predictions"]["results"], golden_set.tokens)


@pytest.fixture
def submission(golden) -> dict:
    """A valid submission to damage: the recorded one, copied."""
    return json.loads(json.dumps(golden["predictions"]))
