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


def same(left, right):
    assert left.as_dict() == right.as_dict()


def test_order_and_repetition_do_not_matter(problem):
    evaluation_set, predictions = problem
    metric = DetectionMetric(evaluation_set)
    for samples in ([4, 5], [0, 1], [1, 2, 3], [0]):
        tokens = [evaluation_set.tokens[sample] for sample in samples]
        metric.update(tokens, of_samples(predictions, samples))
    same(metric.compute(), score_detections(evaluation_set, predictions))


def test_one_table_per_token_equals_one_table(problem):
    evaluation_set, predictions = problem
    metric = DetectionMetric(evaluation_set)
    tables = [of_samples(predictions, [sample]) for sample in range(SAMPLES)]
    for table in tables:
        table.samples = np.zeros_like(table.samples)  # the token says whose boxes these are
    metric.update(evaluation_set.tokens, tables)
    same(metric.compute(), score_detections(evaluation_set, predictions))


def test_unseen_samples_are_empty_or_left_out(problem):
    evaluation_set, predictions = problem
    half = of_samples(predictions, [0, 1, 2])
    tokens = evaluation_set.tokens[:4]  # the fourth was seen and has no box
    official, partial = DetectionMetric(evaluation_set), DetectionMetric(evaluation_set, seen_only=True)
    official.update(tokens, half)
    partial.update(tokens, half)
    same(official.compute(), score_detections(evaluation_set, half))
    same(partial.compute(), score_detections(evaluation_set, half, np.arange(SAMPLES) < 4))
    assert official.compute().overall.num_gt.sum() > partial.compute().overall.num_gt.sum()


def test_reset_and_nothing_seen(problem):
    evaluation_set, predictions = problem
    metric = DetectionMetric(evaluation_set)
    metric.update(evaluation_set.tokens, predictions)
    metric.reset()
    metric.update([], [])
    same(metric.compute(), score_detections(evaluation_set, DetectionTable.empty()))


def test_no_box_is_not_the_same_as_not_seen(problem):
    evaluation_set, _ = problem
    metric = DetectionMetric(evaluation_set, seen_only=True)
    metric.update(evaluation_set.tokens[:2], DetectionTable.empty())
    boxes, seen = metric.collected()
    assert len(boxes) == 0 and seen.tolist() == [True, True] + [False] * (SAMPLES - 2)
    assert metric.compute().overall.num_gt.sum() > 0


def test_global_coordinates_stay_exact(problem):
    evaluation_set, predictions = problem
    metric = DetectionMetric(evaluation_set).half()  # a model in half precision must not take the boxes with it
    metric.update(evaluation_set.tokens, predictions)
    boxes, _ = metric.collected()
    for name in DetectionTable.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(boxes, name), getattr(predictions, name))


def test_wrong_updates_are_refused(problem):
    evaluation_set, predictions = problem
    metric = DetectionMetric(evaluation_set)
    with pytest.raises(ValueError, match="sample 'nope' is not one of the 6"):
        metric.update(["nope"], [DetectionTable.empty()])
    with pytest.raises(ValueError, match="boxes of sample 1, but this update names only"):
        metric.update(evaluation_set.tokens[:1], of_samples(predictions, [0, 1]))
    with pytest.raises(ValueError):
        metric.update(evaluation_set.tokens[:2], [DetectionTable.empty()])


def _rank(rank: int, folder: str, shards: list[list[int]]) -> None:
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=len(shards))
    evaluation_set, predictions = random_problem(SAMPLES, 12, 30, SEED)
    metric = DetectionMetric(evaluation_set)
    results = []
    for shard in (shards[rank], [] if rank == 0 else list(range(SAMPLES))):  # uneven, then with an empty rank
        metric.reset()
        for sample in shard:
            metric.update([evaluation_set.tokens[sample]], of_samples(predictions, [sample]))
        results.append(metric.compute().as_dict())
        assert len(metric.collected()[1].nonzero()[0]) == len(shard), "afterwards the rank has its own boxes again"
    metric.reset()
    results.append(metric.compute().as_dict())  # nobody saw anything
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
