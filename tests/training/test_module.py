"""Learning as a whole: real frames, real model, official metric."""

import numpy as np
import pytest
import torch

from src.assembly import build_datamodule, build_module, data_root
from src.config import compose_config
from src.data.frame_loader import collate
from src.metrics.detection import score_detections
from src.metrics.submission import to_global
from src.structures.detections import DetectionTable, EvaluationSet
from src.structures.taxonomy import CLASSES

WORLD = [
    "data.world.num_train_scenes=1", "data.world.num_val_scenes=1", "data.world.key_frames_per_scene=10",
    "data.world.num_workers=0", "data.num_workers=0",
]  # fmt: skip


EPOCHS, BATCH_SIZE = 36, 2


@pytest.fixture(scope="module")
def ten_frames(tmp_path_factory):
    """A module of the mini model, the ten frames of a small world, and their annotations."""
    outputs = tmp_path_factory.mktemp("outputs")
    config, tree = compose_config(["scale=mini", "data.split=train", f"paths.outputs={outputs}", *WORLD])
    torch.manual_seed(0)
    datamodule = build_datamodule(config, data_root(config))
    module = build_module(config, tree, datamodule)
    frames = [datamodule.reader.read(sample, None) for sample in range(10)]
    return module, frames, datamodule.evaluation_set()


def batches(frames, order):
    return [collate([frames[i] for i in part]) for part in order.split(BATCH_SIZE)]


def score(module, frames, truth: EvaluationSet):
    module.eval()
    tables = []
    for batch in batches(frames, torch.arange(len(frames))):
        with torch.no_grad():
            boxes = module.model.decode(module.run(batch))
        poses = batch.global_from_ego.numpy()
        tables += [to_global(b, poses[i], truth.index_of[batch.tokens[i]]) for i, b in enumerate(boxes)]
    module.train()
    return score_detections(truth, DetectionTable.concatenate(tables))


@pytest.mark.exhaustive
def test_ten_frames_are_overfitted(ten_frames):
    """Over 0.9 AP, averaged over the classes that are present (method 15.10)."""
    module, frames, truth = ten_frames
    steps = EPOCHS * len(frames) // BATCH_SIZE
    optimizer = torch.optim.AdamW(module.model.parameters(), lr=2e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 2e-3, total_steps=steps)
    random = torch.Generator().manual_seed(0)
    for _ in range(EPOCHS):
        for batch in batches(frames, torch.randperm(len(frames), generator=random)):
            terms = module.model.loss(module.run(batch), batch).terms
            optimizer.zero_grad()
            terms["total"].backward()
            torch.nn.utils.clip_grad_norm_(module.model.parameters(), 35.0)
            optimizer.step()
            schedule.step()
    scores = score(module, frames, truth).overall
    present = scores.num_gt > 0
    found = {name: round(float(ap), 3) for name, ap in zip(CLASSES, scores.class_ap, strict=True) if ap > 0}
    assert present.sum() >= 6
    assert np.mean(scores.class_ap[present]) > 0.9, found
