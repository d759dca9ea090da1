"""Collecting boxes over batches and processes."""

import math
import pickle
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from src.benchmark.suite_metric import random_problem
from src.geometry.bev_grid import BEVGrid
from src.metrics.bootstrap import with_intervals
from src.metrics.detection import score_detections
from src.metrics.diagnostics import FrameDiagnosis, diagnose
from src.reliability.processes import process_group
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from src.structures.detections import DetectionTable
from src.structures.evidence import Evidence, HeadCells, SplattedCells
from src.training.evaluator import DetectionEvaluator
from tests.evaluation_sets import set_of
from tests.gaussian_sets import gaussians_at
from tests.models.moving import UTM, bda, pose
from tests.training.two_ranks import become, spawn_two

SAMPLES = 6


@pytest.fixture(scope="module")
def problem():
    return random_problem(SAMPLES, 12, 30, 3)


def by_sample(table, samples):
    return {sample: table[table.samples == sample] for sample in samples}


def same(left, right):
    for name in DetectionTable.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(left, name), getattr(right, name), strict=True)


def diagnoses_of(evaluation_set, samples):
    counts = np.bincount(evaluation_set.ground_truth.samples, minlength=SAMPLES)
    return {s: FrameDiagnosis(np.zeros(counts[s]), None, None, None, {"radar_near": (s, 10)}) for s in samples}


def compute_as(rank, port, folder, evaluation_set, shards):
    """As one of two: score what this rank saw, then that nobody saw anything."""
    become(rank, 2, port)
    evaluator, found = DetectionEvaluator(evaluation_set), []
    with process_group("cpu", 2):
        for boxes in (shards[rank], {}):
            evaluator.reset()
            evaluator.boxes |= boxes
            evaluator.diagnoses |= diagnoses_of(evaluation_set, boxes)
            evaluator.compute()
            found.append((evaluator.detections, evaluator.as_dict()))
    (folder / f"{rank}.pickle").write_bytes(pickle.dumps(found))


@pytest.mark.slow
@pytest.mark.parametrize("first", [[4], []], ids=["a repeated sample", "no sample"])
def test_two_processes_in_any_order_give_the_numbers_of_one(problem, tmp_path, first):
    evaluation_set, predictions = problem
    shards = [by_sample(predictions, first), by_sample(predictions, [5, 4, 3, 2, 1, 0])]
    spawn_two(compute_as, tmp_path, evaluation_set, shards)
    diagnoses = diagnoses_of(evaluation_set, range(SAMPLES))
    expected = with_intervals(score_detections(evaluation_set, predictions, diagnoses))
    assert expected["measures"]["radar_near"] == 15 / 60
    nothing = with_intervals(score_detections(evaluation_set, DetectionTable.empty()))
    for rank in range(2):
        (table, scores), (empty, of_none) = pickle.loads((tmp_path / f"{rank}.pickle").read_bytes())
        same(table, predictions[np.argsort(predictions.samples, kind="stable")])
        same(empty, DetectionTable.empty())
        assert (scores, of_none) == (expected, nothing)


def test_nobody_saw_anything(problem):
    evaluator = DetectionEvaluator(problem[0])
    evaluator.boxes |= by_sample(problem[1], range(SAMPLES))
    evaluator.reset()
    evaluator.compute()
    same(evaluator.detections, DetectionTable.empty())


def test_a_batch_goes_to_its_samples_and_a_repeated_one_counts_once(problem):
    evaluation_set, _ = problem
    evaluator = DetectionEvaluator(evaluation_set)
    box = Boxes3D(torch.zeros(1, 3), torch.ones(1, 3), *torch.zeros(1, 1), torch.zeros(1, 2), *torch.zeros(2, 1).long())
    model = SimpleNamespace(decode=lambda output: output, evidence=lambda output: Evidence())
    batch = FrameBatch(
        tokens=[evaluation_set.tokens[row] for row in (4, 1)],
        timestamps_s=torch.zeros(2).double(),
        global_from_ego=torch.eye(4).repeat(2, 1, 1).double(),
        aug_from_ego=torch.eye(4).repeat(2, 1, 1),
    )
    for _ in range(2):
        evaluator.update(model, [box, Boxes3D.empty()], batch)
    evaluator.compute()
    assert evaluator.detections.samples.tolist() == [4] and evaluator.boxes.keys() == {1, 4}


GRID = BEVGrid(cells=(60, 60), cell_m=1.0, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))


@pytest.mark.parametrize("autocast", [False, True])
def test_evidence_is_compared_with_the_truth_of_its_sample_in_the_augmented_frame(autocast, monkeypatch):
    """Two vehicles that head elsewhere, each augmented in its own way, with trucks of 6 x 2 m along their headings."""
    yaws, places = (math.pi / 2, -0.3), [[[10.0, 0, 1], [-8.0, 6, 1]], [[6.0, 7, 1]]]  # in the vehicles' frames
    poses = torch.stack([pose(yaw=yaws[0], origin=UTM), pose(5.0, 2.0, yaws[1], UTM)])
    augs = torch.stack([bda(0.4, 1.1, flip_y=True), bda(-0.2, 0.9, flip_x=True)])

    def in_aug(sample, *point):
        return (augs[sample] @ torch.tensor([*point, 1.0]))[:3]

    def cell_at(sample, *point):
        return [sample, *GRID.cell_of(in_aug(sample, *point)[:2]).tolist()]

    # The evaluation set has the second of the batch first.
    rows = [(0, yaws[1], poses[1], places[1][0]), *((1, yaws[0], poses[0], place) for place in places[0])]
    truth = DetectionTable(
        samples=np.array([sample for sample, *_ in rows]),
        labels=np.zeros(3, np.int64),
        centers=np.stack([(p @ torch.tensor([*place, 1.0], dtype=p.dtype))[:3].numpy() for *_, p, place in rows]),
        sizes=np.tile([2.0, 6.0, 2.0], (3, 1)),
        rotations=np.array([[math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)] for _, yaw, *_ in rows]),
        velocities=np.zeros((3, 2)),
        attributes=np.full(3, -1),
        scores=np.zeros(3),
        num_points=np.ones(3, np.int64),
    )
    ends = [
        (0, 12.7, 0, 1.9),
        (0, 10, 1.3, 1),
        (1, 8.7, 7.8, 0.2),
        (1, 3.3, 7, 1),
        (1, 6, 7, 2.2),
    ]  # two of them beside
    evidence = Evidence(
        gaussians=gaussians_at(torch.stack([in_aug(0, -8, 6, 1)[:2], in_aug(1, -8, 6, 1)[:2]])[:, None]),
        cells=SplattedCells(
            GRID,
            torch.tensor([cell_at(0, 10, 0, 0), cell_at(0, 6, 7, 0), cell_at(1, 6, 7, 0)]),
            torch.ones(3),
            torch.tensor([False, True, True]),
        ),
        head_cells=HeadCells(GRID, torch.tensor([cell_at(0, 7.5, 0, 0), cell_at(1, 10, 0, 0)])),
    )
    batch = FrameBatch(
        tokens=["b", "a"],
        timestamps_s=torch.zeros(2).double(),
        global_from_ego=poses,
        aug_from_ego=augs,
        radar_points=torch.stack([torch.cat([in_aug(*end), torch.zeros(4)]) for end in ends]),
        radar_batch=torch.tensor([sample for sample, *_ in ends]),
    )
    evaluator = DetectionEvaluator(set_of(truth, "ab"))
    model = SimpleNamespace(decode=lambda output: [Boxes3D.empty()] * 2, evidence=lambda output: evidence)
    compared = []
    monkeypatch.setattr("src.training.evaluator.diagnose", lambda *args: compared.extend(args[2]) or diagnose(*args))
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        evaluator.update(model, None, batch)
    for sample, boxes in enumerate(compared):
        torch.testing.assert_close(boxes.centers, torch.stack([in_aug(sample, *place) for place in places[sample]]))
    first, second = evaluator.diagnoses[0], evaluator.diagnoses[1]
    assert second.points.tolist() == [1, 0] and first.points.tolist() == [2]
    assert second.occupied.tolist() == [False, False] and first.occupied.tolist() == [True]
    assert second.head.tolist() == [True, False] and first.head.tolist() == [False]
    assert second.covered[:, 0].tolist() == [False, True] and not first.covered.any()
