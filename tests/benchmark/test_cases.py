"""What suites measure is made of a checkpoint alone."""

import pytest
import torch

from src.benchmark.cases import measured_model
from src.config import compose_config
from tests.untrained import write_checkpoint


@pytest.mark.slow  # a ResNet-50 on disk
def test_the_pretrained_file_need_not_be_there(tmp_path):
    settings = ["scale=debug", "phase=phase1", "backbone=resnet50", "backbone.weights=/nowhere/weights.pth"]
    path = write_checkpoint(tmp_path / "a.ckpt", *settings)
    model = measured_model(compose_config([*settings, f"checkpoint={path}"])[0])
    stored = torch.load(path, weights_only=True)["state_dict"]
    assert all(torch.equal(value, stored[f"model.{key}"]) for key, value in model.state_dict().items())
