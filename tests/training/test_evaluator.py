"""Collecting boxes over batches and processes."""

import pickle
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from src.benchmark.suite_metric import random_problem
from src.metrics.bootstrap import with_intervals
from src.metrics.detection import score_detections
from src.metrics.diagnostics import FrameDiagnosis
from src.reliability.processes import process_group
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from src.structures.detections import DetectionTable
from src.structures.evidence import Evidence
from src.training.evaluator import DetectionEvaluator
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
