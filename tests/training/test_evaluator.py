"""Collecting boxes over batches and processes."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from src.benchmark.suite_metric import random_problem
from src.metrics.detection import score_detections
from src.structures.boxes import Boxes3D
from src.structures.detections import DetectionTable
from src.training import evaluator as module
from src.training.evaluator import DetectionEvaluator

SAMPLES = 6


@pytest.fixture(scope="module")
def problem():
    return random_problem(SAMPLES, 12, 30, 3)


def by_sample(table, samples):
    return {sample: table[table.samples == sample] for sample in samples}


def same(left, right):
    for name in DetectionTable.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(left, name), getattr(right, name), strict=True)


def test_ranks_in_any_order_with_repetitions_give_the_table_of_one(problem, monkeypatch):
    evaluation_set, predictions = problem
    shards = [by_sample(predictions, [4]), {}, by_sample(predictions, [5, 4, 3, 2, 1, 0])]
    evaluator = DetectionEvaluator(evaluation_set)
    monkeypatch.setattr(module, "gather_by_rank", lambda own: [own, *shards])
    evaluator.compute()
    same(evaluator.detections, predictions[np.argsort(predictions.samples, kind="stable")])
    assert evaluator.as_dict() == score_detections(evaluation_set, predictions).as_dict()


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
    model = SimpleNamespace(decode=lambda output: output)
    batch = SimpleNamespace(
        tokens=[evaluation_set.tokens[row] for row in (4, 1)], global_from_ego=torch.eye(4).repeat(2, 1, 1).double()
    )
    for _ in range(2):
        evaluator.update(model, [box, Boxes3D.empty()], batch)
    evaluator.compute()
    assert evaluator.detections.samples.tolist() == [4] and evaluator.boxes.keys() == {1, 4}
