"""Collecting boxes over batches and processes."""

import numpy as np
import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as mp

from src.benchmark.suite_metric import random_problem
from src.metrics.detection import DetectionMetric, score_detections
from src.structures.detections import DetectionTable

SAMPLES, SEED = 6, 3


@pytest.fixture(scope="module")
def problem():
    return random_problem(SAMPLES, 12, 30, SEED)


def of_samples(table: DetectionTable, samples) -> DetectionTable:
    return table[np.isin(table.samples, samples)]


def add(metric, predictions, samples):
    for sample in samples:
        metric.update(sample, of_samples(predictions, [sample]))


def same(left, right):
    for name in DetectionTable.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(left, name), getattr(right, name))


def test_order_and_repetition_do_not_matter(problem):
    evaluation_set, predictions = problem
    metric = DetectionMetric(evaluation_set)
    add(metric, predictions, [4, 5, 0, 1, 1, 2, 3, 0])
    same(metric.compute(), predictions[np.argsort(predictions.samples, kind="stable")])


def test_the_updated_sample_says_whose_boxes_these_are(problem):
    evaluation_set, predictions = problem
    metric = DetectionMetric(evaluation_set)
    for sample in range(SAMPLES):
        table = of_samples(predictions, [sample])
        table.samples = np.zeros_like(table.samples)
        metric.update(sample, table)
    same(metric.compute(), predictions[np.argsort(predictions.samples, kind="stable")])


def test_samples_without_boxes_and_reset(problem):
    evaluation_set, predictions = problem
    metric = DetectionMetric(evaluation_set)
    add(metric, predictions, range(SAMPLES))
    metric.reset()
    add(metric, predictions, [2])
    metric.update(3, DetectionTable.empty())
    same(metric.compute(), of_samples(predictions, [2]))


def test_global_coordinates_stay_exact(problem):
    evaluation_set, predictions = problem
    metric = DetectionMetric(evaluation_set).half()  # a model in half precision must not take the boxes with it
    add(metric, predictions, range(SAMPLES))
    same(metric.compute(), predictions)


def _rank(rank: int, folder: str, shards: list[list[int]]) -> None:
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=len(shards))
    evaluation_set, predictions = random_problem(SAMPLES, 12, 30, SEED)
    metric = DetectionMetric(evaluation_set)
    results = []
    for shard in (shards[rank], [] if rank == 0 else list(range(SAMPLES))):  # uneven, then with an empty rank
        metric.reset()
        add(metric, predictions, shard)
        results.append(score_detections(evaluation_set, metric.compute()).as_dict())
        assert len({int(block[0, 0]) for block in metric.blocks if len(block)}) == len(shard), "its own boxes again"
    metric.reset()
    results.append(score_detections(evaluation_set, metric.compute()).as_dict())  # nobody saw anything
    torch.save(results, f"{folder}/{rank}.pt")
    dist.destroy_process_group()


@pytest.mark.slow
def test_two_processes_give_the_numbers_of_one(problem, tmp_path):
    evaluation_set, predictions = problem
    # Sample 4 was seen by both, as a padded sampler does; the second rank has far more boxes than the first.
    mp.start_processes(_rank, args=(str(tmp_path), [[4], [5, 4, 3, 2, 1, 0]]), nprocs=2, start_method="forkserver")
    expected = score_detections(evaluation_set, predictions).as_dict()
    nothing = score_detections(evaluation_set, DetectionTable.empty()).as_dict()
    for rank in range(2):
        assert torch.load(tmp_path / f"{rank}.pt") == [expected, expected, nothing]
