"""Learning as a whole: real frames, real model, official metric."""

import numpy as np
import pytest
import torch

from src.assembly import build_datamodule, build_module, data_root
from src.config import compose_config
from src.data.datamodule import collate
from src.errors import DivergedError
from src.metrics.detection import score_detections
from src.metrics.submission import to_global
from src.structures.detections import DetectionTable, EvaluationSet
from src.structures.taxonomy import CLASSES

WORLD = [
    "data.world.num_train_scenes=1", "data.world.num_val_scenes=1", "data.world.key_frames_per_scene=2",
    "data.world.num_workers=0", "data.num_workers=0",
]  # fmt: skip


@pytest.fixture(scope="module")
def two_frames(tmp_path_factory):
    """A module of the mini model, the two frames of a small world as one batch, and their annotations."""
    outputs = tmp_path_factory.mktemp("outputs")
    config, tree = compose_config(["scale=mini", "data.split=train", f"paths.outputs={outputs}", *WORLD])
    torch.manual_seed(0)
    datamodule = build_datamodule(config, data_root(config))
    module = build_module(config, tree, datamodule)
    batch = collate([datamodule.reader.read(sample, None) for sample in (0, 1)])
    return module, batch, datamodule.evaluation_set()


def score(module, batch, truth: EvaluationSet):
    module.eval()
    with torch.no_grad():
        boxes = module.detect(batch)
    module.train()
    poses = batch.global_from_ego.numpy()
    tables = [to_global(b, poses[i], truth.index_of[batch.tokens[i]]) for i, b in enumerate(boxes)]
    return score_detections(truth, DetectionTable.concatenate(tables))


@pytest.mark.slow
def test_two_frames_are_overfitted(two_frames):
    """Over 0.9 AP, averaged over the classes that are present (specification 15.10)."""
    module, batch, truth = two_frames
    optimizer = torch.optim.AdamW(module.model.parameters(), lr=2e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 2e-3, total_steps=STEPS)
    for _ in range(STEPS):
        terms = module.model.loss(module.run(batch), batch)
        optimizer.zero_grad()
        terms["total"].backward()
        torch.nn.utils.clip_grad_norm_(module.model.parameters(), 35.0)
        optimizer.step()
        schedule.step()
    scores = score(module, batch, truth).overall
    present = scores.num_gt > 0
    found = {name: round(float(ap), 3) for name, ap in zip(CLASSES, scores.class_ap, strict=True) if ap > 0}
    assert present.sum() >= 6
    assert np.mean(scores.class_ap[present]) > 0.9, found


STEPS = 75


def test_a_loss_that_is_not_finite_stops_and_names_its_terms(two_frames):
    module, batch, _ = two_frames
    terms = {"heatmap": torch.tensor(float("nan")), "box": torch.tensor(1.0), "total": torch.tensor(float("nan"))}
    module._trainer = type("Trainer", (), {"global_step": 7})()
    with pytest.raises(DivergedError, match=rf"step 7.*heatmap.*{batch.tokens[0]}"):
        module._check_finite(terms, batch)
    module._trainer = None
