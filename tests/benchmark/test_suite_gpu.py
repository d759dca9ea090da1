"""The suite for a GPU: what of it runs without one."""

from dataclasses import replace

import pytest
import torch

from src.benchmark import suite_gpu
from src.benchmark.scenes import ROADS
from src.benchmark.suite_gpu import frame_seconds, full_case, measure
from src.config import compose_config
from src.errors import ConfigError
from src.training.trainer_config import Accelerator


@pytest.fixture(scope="module")
def config():
    config, _ = compose_config(["scale=debug", "phase=phase2", "trainer.accelerator=cpu"])
    return replace(config, data=replace(config.data, batch_size=1))


def test_without_a_gpu_it_says_so(config):
    with pytest.raises(ConfigError, match="suite=gpu measures on a GPU, but trainer.accelerator gives cpu"):
        measure(config, {})


def test_frames_differ_and_the_first_ones_do_not_count(config, monkeypatch):
    monkeypatch.setattr(suite_gpu, "DRAWS", 2)
    monkeypatch.setattr(suite_gpu, "WARM_UP", 1)
    case = full_case(config, torch.device("cpu"))
    infer, seen = case.infer, []
    monkeypatch.setattr(case, "infer", lambda: seen.append(case.batch.radar_points) or infer())
    assert len(frame_seconds(case, ROADS["debug"], 2)) == 2 and len(seen) == 3
    assert seen[0] is seen[2] and not torch.equal(seen[0], seen[1])


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_a_frame_and_a_step_on_a_gpu(config, monkeypatch):
    monkeypatch.setattr(suite_gpu, "FRAMES", 100)
    page = measure(replace(config, trainer=replace(config.trainer, accelerator=Accelerator.gpu)), {})
    assert page["a frame"][0]["waits"] <= page["a frame"][0]["waits counted"]
