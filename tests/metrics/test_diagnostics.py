"""What inner state has to do with the truth: two small frames worked by hand."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from src.metrics.diagnostics import diagnose, measures_of, sums_by_sample
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from src.structures.detections import DetectionTable, EvaluationSet
from src.structures.evidence import Evidence, SplattedCells
from src.structures.gaussians import GaussianSet, Source
from tests.targets.box_rows import GRID, boxes_of

# x, y, l, w, yaw, vx, vy: a fast car, a standing one, one of unknown speed out of every reach.
BOXES = boxes_of((10, 0, 4, 2, 0, 20, 0), (0, 8, 4, 2, 0, 0, 0), (-14, -9, 0.2, 0.2, 0, torch.nan, torch.nan))


def gaussians_of(*rows) -> GaussianSet:
    """One sample of rows (source, x, y, vx, opacity)."""
    columns = torch.tensor([row[1:] for row in rows], dtype=torch.float32)[None]
    pair = torch.zeros(1, len(rows), 2)
    return GaussianSet(
        means=columns[..., :2],
        scales=pair + 1,
        directions=pair,
        opacity_logits=torch.logit(columns[..., 3]),
        velocities=torch.stack([columns[..., 2], torch.zeros(1, len(rows))], -1),
        features=torch.zeros(1, len(rows), 1),
        sources=torch.tensor([[int(row[0]) for row in rows]]),
        elapsed_s=torch.zeros(1, len(rows)),
        valid=torch.ones(1, len(rows), dtype=torch.bool),
    )


GAUSSIANS = gaussians_of(
    (Source.RADAR, 10, 0, 17, 0.9),  # inside the fast car, 3 m/s wrong
    (Source.RADAR, 10, 3, 15, 0.9),  # 2 m beside it, 5 m/s wrong
    (Source.RADAR, 0, 8, 9, 0.05),  # on the standing one: no mover
    (Source.HISTORY, 14.3, 0, 20, 0.5),  # 2.3 m ahead of the fast car
    (Source.HISTORY, 14.5, 0, 0, 0.05),  # 2.5 m: not near
    (Source.HISTORY, -10, 0, 0, 0.05),
    (Source.CAMERA, 30, 0, 0, 0.5),
)


def batch_of(boxes: Boxes3D, points=()) -> FrameBatch:
    points = torch.tensor(points, dtype=torch.float32).reshape(-1, 3)
    return FrameBatch(
        tokens=["a"],
        timestamps_s=torch.zeros(1).double(),
        global_from_ego=torch.eye(4)[None].double(),
        aug_from_ego=torch.eye(4)[None],
        radar_points=torch.cat([points, torch.zeros(len(points), 4)], 1),
        radar_batch=torch.zeros(len(points), dtype=torch.int64),
        boxes=[boxes],
    )


def table_of(boxes: Boxes3D, samples) -> DetectionTable:
    n = len(boxes)
    return DetectionTable(
        samples=np.array(samples),
        labels=boxes.labels.numpy(),
        centers=boxes.centers.double().numpy(),
        sizes=boxes.sizes.double().numpy(),
        rotations=np.tile([1.0, 0, 0, 0], (n, 1)),
        velocities=boxes.velocities.double().numpy(),
        attributes=np.full(n, -1),
        scores=np.zeros(n),
        num_points=np.ones(n, np.int64),
    )


def measured(evidence, kept=(True, True, True)):
    (found,) = diagnose(evidence, batch_of(BOXES))
    evaluation_set = EvaluationSet(["a"], np.zeros((1, 3)), [()], table_of(BOXES, [0, 0, 0]), DetectionTable.empty())
    return measures_of(sums_by_sample({0: found}, evaluation_set, np.array(kept)))


def test_gaussians_by_source():
    measures = measured(Evidence(GAUSSIANS))
    expected = {"radar": (3, 1, 1 / 3, 4.0), "history": (3, 1 / 3, 2 / 3, 0.0), "camera": (1, 0, 0, None)}
    expected["random"] = (0, None, None, None)
    names = ("gaussians", "near", "faint", "velocity_error")
    for source, values in expected.items():
        for name, value in zip(names, values, strict=True):
            assert measures[f"{source}_{name}"] == (value if value is None else pytest.approx(value)), (source, name)


def test_objects_that_history_covers_are_those_that_count():
    assert measured(Evidence(GAUSSIANS))["remembered_objects"] == pytest.approx(1 / 3)
    assert measured(Evidence(GAUSSIANS), (True, True, False))["remembered_objects"] == pytest.approx(1 / 2)


def test_padding_says_nothing_and_no_memory_has_no_share():
    single = replace(GAUSSIANS, valid=GAUSSIANS.sources != Source.HISTORY)
    measures = measured(Evidence(single))
    assert measures["history_near"] is None and "remembered_objects" not in measures
    assert measures["radar_near"] == 1
    assert measured(Evidence()) == {}


def test_cells_and_points_in_boxes():
    indices = torch.tensor([[0, 10, 24], [0, 18, 15], [1, 1, 1]])  # (24.5 - 15, 0.5): in the fast car; (0.5, 8.5)
    cells = SplattedCells(GRID, indices, torch.ones(3), torch.tensor([True, False, True]))
    points = [(10, 0, 1), (12, 1, 1.5), (10, 0, 2), (0, 8, 1)]
    (found,) = diagnose(Evidence(cells=cells), batch_of(BOXES, points))
    assert found.occupied.tolist() == [True, False, False], "the second is only reached, the third is another sample's"
    assert found.points.tolist() == [2, 1, 0] and found.remembered is None


def test_samples_add_up_and_boxes_must_be_those_of_the_set():
    diagnoses = {1: diagnose(Evidence(GAUSSIANS), batch_of(BOXES))[0]}
    diagnoses[0] = diagnose(Evidence(gaussians_of((Source.RADAR, 25, 0, 0, 0.9))), batch_of(Boxes3D.empty()))[0]
    truth = table_of(BOXES, [1, 1, 1])
    evaluation_set = EvaluationSet(["a", "b"], np.zeros((2, 3)), [(), ()], truth, DetectionTable.empty())
    measures = measures_of(sums_by_sample(diagnoses, evaluation_set, np.ones(3, bool)))
    assert measures["radar_near"] == pytest.approx(3 / 4) and measures["radar_gaussians"] == 2
    with pytest.raises(ValueError, match="sample a: 3 boxes in its batch, but 0"):
        sums_by_sample({0: diagnoses[1]}, evaluation_set, np.ones(3, bool))
    with pytest.raises(ValueError, match="without annotations"):
        diagnose(Evidence(), replace(batch_of(BOXES), boxes=None))
