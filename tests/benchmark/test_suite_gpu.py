"""The suite for a GPU: what of it runs without one."""

import itertools
from dataclasses import replace

import pytest
import torch

from src.benchmark import suite_gpu
from src.benchmark.scenes import made_batch
from src.benchmark.suite_gpu import GRAPH, LAUNCHED, following, frame_rows, frame_seconds, full_case, measure, part_rows
from src.config import compose_config
from src.errors import ConfigError
from src.ops import backend
from src.training.trainer_config import Accelerator


def config_of(*overrides):
    config, _ = compose_config(["scale=debug", "phase=phase2", "trainer.accelerator=cpu", *overrides])
    return replace(config, data=replace(config.data, batch_size=1))


def test_without_a_gpu_it_says_so():
    with pytest.raises(ConfigError, match="suite=gpu measures on a GPU, but trainer.accelerator gives cpu"):
        measure(config_of(), {})


def test_frames_differ_follow_each_other_and_the_first_ones_do_not_count(monkeypatch):
    monkeypatch.setattr(suite_gpu, "WARM_UP", 1)
    monkeypatch.setattr(suite_gpu, "FRAMES", 3)
    draws = [made_batch(1, suite_gpu.ROADS["debug"], (8, 8), seed=draw) for draw in range(2)]
    seen, clock = [], itertools.count()
    seconds = frame_seconds(seen.append, following(draws), lambda: float(next(clock)))
    assert seconds == [1.0, 1.0, 1.0]
    assert [float(frame.timestamps_s[0]) for frame in seen] == [0.0, 0.5, 1.0, 1.5]
    assert seen[0].radar_points is seen[2].radar_points
    assert not torch.equal(seen[0].radar_points, seen[1].radar_points)
    monkeypatch.setattr(suite_gpu, "BUDGET_S", 2.0)
    assert frame_seconds(seen.append, following(draws), lambda: float(next(clock))) == [1.0, 1.0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("overrides", "ways"),
    [((), [LAUNCHED, GRAPH]), (("precision=bf16-mixed",), [LAUNCHED, GRAPH]), (("model=dense_bev",), [LAUNCHED])],
    ids=["ours", "ours in bfloat16", "a model without fixed shapes"],
)
def test_each_way_to_run_a_frame_is_measured(overrides, ways, monkeypatch):
    """The graph's frames are launched here: its kernels are the reference's."""
    monkeypatch.setattr(suite_gpu, "WARM_UP", 1)
    monkeypatch.setattr(suite_gpu, "FRAMES", 2)
    monkeypatch.setattr(suite_gpu, "PART_FRAMES", 2)
    monkeypatch.setattr(suite_gpu, "busy_seconds", lambda function: (function(), 0.0)[1])
    case = full_case(config_of(*overrides), torch.device("cpu"))
    monkeypatch.setattr(backend, "chosen", lambda: backend.TRITON)
    monkeypatch.setattr(backend, "implementation", lambda reference: reference)
    rows = frame_rows(case, "debug")
    assert [row["way"] for row in rows] == ways and all(row["frames"] == 2 for row in rows)
    assert all(row.get("beyond a capacity", 0) == 0 for row in rows)
    parts = part_rows(case)
    assert {row["part"] for row in parts} == {*case.model.latency_parts, "total"}
    assert parts[-1]["ms"] >= max(row["ms"] for row in parts)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_a_frame_and_a_step_on_a_gpu(monkeypatch):
    monkeypatch.setattr(suite_gpu, "FRAMES", 100)
    config = config_of("precision=bf16-mixed")
    page = measure(replace(config, trainer=replace(config.trainer, accelerator=Accelerator.gpu)), {})
    assert [row["way"] for row in page["a frame"]] == [LAUNCHED, GRAPH]
    assert page["a frame"][1]["beyond a capacity"] == 0
    assert page["a frame on the GPU"][0]["waits"] <= page["a frame on the GPU"][0]["waits counted"]
