"""Two processes train and score as one with the same batch does (CPU, gloo)."""

import copy
import importlib.util
import os
import socket
import time
from dataclasses import dataclass, replace
from pathlib import Path

import lightning as L
import numpy as np
import pytest
import torch
import torch.multiprocessing as mp
from torch.utils.data import DataLoader

from src.data.datamodule import collate, in_lane
from src.metrics.detection import score_detections
from src.models.horizon3d.kggi import Initialization
from src.structures.detections import DetectionTable, EvaluationSet
from src.training.optim import OptimConfig
from src.training.processes import SharedBuffers, build_strategy, process_group
from src.training.temporal import TemporalModule

LANES, STEPS = 4, 3
FIRST_RANK, SECOND_RANK = (0, 1), (2, 3)
DEADLINE_S = 300.0
COLUMNS = tuple(DetectionTable.__dataclass_fields__)


def _of_the_models_tests():
    """The small model and its frames are described beside the model's own tests."""
    path = Path(__file__).parents[1] / "models" / "horizon3d" / "conftest.py"
    spec = importlib.util.spec_from_file_location("horizon3d_conftest", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


parts = _of_the_models_tests()
grid, backbone, make_batch = parts.grid, parts.backbone, parts.make_batch
make_config, make_model = parts.make_config, parts.make_model


@dataclass
class Work:
    """What one process does, as values that travel to it."""

    model: torch.nn.Module
    train: list[list]  # per step and lane, a batch of one
    validation: list[list]  # of each of two processes, batches
    truth: EvaluationSet
    folder: Path
    eval_norms: bool = True


class Module(TemporalModule):
    """Plain gradient descent, so that a parameter's change is its gradient, and norms and dropout held still."""

    eval_norms = True
    totals = ()

    def on_train_batch_start(self, batch, batch_idx):
        super().on_train_batch_start(batch, batch_idx)
        if self.eval_norms:
            self.model.eval()

    def training_step(self, batch, batch_idx):
        total = super().training_step(batch, batch_idx)
        self.totals = [*self.totals, float(total.detach())]
        return total

    def configure_optimizers(self):
        return torch.optim.SGD(self.model.parameters(), lr=1e-3)


def work_as(rank, world_size, port, work):
    """Train three steps and validate, as rank `rank` of `world_size`; the result goes to a file."""
    torch.set_num_threads(1)
    if world_size > 1:
        who = {"LOCAL_RANK": rank, "RANK": rank, "WORLD_SIZE": world_size}
        who |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
        os.environ.update({name: str(value) for name, value in who.items()})
    optim = OptimConfig(
        lr=1e-3, weight_decay=0.0, clip_norm=35.0, peak_lr_ratio=1.0, final_lr_ratio=1.0, rise_fraction=0.5,
        betas=[0.9, 0.99], cycled_beta1=None, ema_decay=None,
    )  # fmt: skip
    # Tensors travel to a process as shared memory, in which the other would see them trained.
    module = Module(copy.deepcopy(work.model), optim, 1.0, work.truth, 0, {})
    module.eval_norms = work.eval_norms
    lanes = (FIRST_RANK, SECOND_RANK)[rank] if world_size > 1 else range(LANES)
    train = [collate([frames[lane] for lane in lanes]) for frames in work.train]
    validation = work.validation[rank] if world_size > 1 else [batch for part in work.validation for batch in part]
    with process_group("cpu", world_size):
        trainer = L.Trainer(
            max_epochs=1, accelerator="cpu", devices=world_size, strategy=build_strategy("cpu", world_size),
            callbacks=[SharedBuffers()], logger=False, enable_checkpointing=False, enable_progress_bar=False,
            enable_model_summary=False, num_sanity_val_steps=0, use_distributed_sampler=False,
        )  # fmt: skip
        loaders = [DataLoader(batches, batch_size=None, num_workers=0) for batches in (train, validation)]
        if train:
            trainer.fit(module, *loaders)
        else:
            trainer.validate(module, loaders[1], verbose=False)
    result = {
        "totals": module.totals,
        "state": module.model.state_dict(),
        "detections": {name: torch.from_numpy(getattr(module.detections, name)) for name in COLUMNS},
    }
    torch.save(result, work.folder / f"{world_size}-{rank}.pt")


def in_one_process(work):
    work_as(0, 1, 0, work)
    return torch.load(work.folder / "1-0.pt", weights_only=True)


def in_two_processes(work):
    """Both ranks with a deadline; their results."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    context = mp.spawn(work_as, (2, port, work), nprocs=2, join=False)
    deadline = time.monotonic() + DEADLINE_S
    try:
        while not context.join(timeout=1.0):
            assert time.monotonic() < deadline, "the two processes hang"
    finally:
        for process in context.processes:
            if process.is_alive():
                process.kill()
    return [torch.load(work.folder / f"2-{rank}.pt", weights_only=True) for rank in range(2)]


@pytest.fixture
def frames(make_batch):
    """Batches of one: (lane, step, points, boxes, cameras) -> the frame of that lane and step, half a second each."""

    def build(lane, step, points=60, boxes=5, cameras=True):
        frame = make_batch(points=(points,), boxes=(boxes,), seed=10 * step + lane)
        frame = replace(
            frame,
            tokens=[f"{lane}/{step}"],
            timestamps_s=torch.tensor([0.5 * step], dtype=torch.float64),
            image_valid=frame.image_valid & cameras,
        )
        return in_lane(frame, lane, step % 10 == 0)

    return build


@pytest.fixture
def work(make_model, frames, tmp_path):
    """Three steps in which one process or the other, or a lane, lacks what the other has."""
    model = make_model(dptf=parts.dptf_config(), initialization=Initialization.keypoint)
    model.head.config = replace(model.head.config, score_threshold=0.05)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in model.parameters():  # what starts at zero would hide the parts behind it
            parameter += 0.03 * torch.randn(parameter.shape, generator=generator)
    nothing = {"points": 0, "cameras": False}  # no keypoint, hence no Gaussian at all
    lacking = [
        {lane: {"boxes": 0} for lane in SECOND_RANK},
        {0: {"points": 0}, 1: {"points": 0, "boxes": 1}, 3: {"boxes": 0}},
        {lane: nothing for lane in SECOND_RANK},
    ]
    train = [[frames(lane, step, **lacks.get(lane, {})) for lane in range(LANES)] for step, lacks in enumerate(lacking)]
    validation = [
        [collate([frames(0, 10), frames(1, 10)]), collate([frames(0, 11)]), collate([frames(0, 12, points=0)])],
        [collate([frames(2, 10)])],
    ]
    tokens = [token for part in validation for batch in part for token in batch.tokens]
    return Work(model, train, validation, truth_of(tokens, DetectionTable.empty()), tmp_path)


def truth_of(tokens, boxes):
    return EvaluationSet(tokens, np.zeros((len(tokens), 3)), [()] * len(tokens), boxes, DetectionTable.empty())


def table_of(detections):
    return DetectionTable(**{name: values.numpy() for name, values in detections.items()})


def shifted(detections):
    """Annotations near detections, so that a score is neither 0 nor 1."""
    table = table_of(detections)
    table = table[np.argsort(-table.scores)[: len(table) // 2]]
    centers = table.centers + np.random.default_rng(0).normal(0.0, 0.7, table.centers.shape)
    return replace(table, centers=centers, scores=np.zeros(len(table)), num_points=np.full(len(table), 9))


def numbers(scores, path=""):
    """(path, number) of everything in nested dictionaries."""
    if not isinstance(scores, dict):
        return [(path, scores)]
    return [item for name in scores for item in numbers(scores[name], f"{path}/{name}")]


@pytest.mark.slow
def test_two_processes_train_as_one(work):
    """Losses and every parameter's change over three steps, frames without radar, boxes and Gaussians among them."""
    before = {name: value.clone() for name, value in work.model.state_dict().items()}
    alone = in_one_process(work)
    first, second = in_two_processes(work)
    for step, total in enumerate(alone["totals"]):
        of_ranks = first["totals"][step], second["totals"][step]
        assert np.isfinite(of_ranks).all() and of_ranks[0] != pytest.approx(of_ranks[1], rel=0.01), step
        assert np.mean(of_ranks) == pytest.approx(total, rel=1e-5), step
    changed = 0
    for name, value in alone["state"].items():
        assert torch.equal(first["state"][name], second["state"][name]), name
        change = value - before[name]
        tolerance = 1e-3 * float(change.abs().max()) + 1e-7 if change.numel() else 0.0
        torch.testing.assert_close(first["state"][name] - before[name], change, rtol=0.0, atol=tolerance, msg=name)
        changed += bool((change != 0).any())
    assert changed > 350


@pytest.mark.slow
def test_two_processes_score_as_one_does_their_checkpoint(work):
    """With batch statistics of their own, and with different numbers of validation batches."""
    work.eval_norms = False
    first, second = in_two_processes(work)
    assert np.isfinite(first["totals"] + second["totals"]).all()
    assert len(work.validation[0]) != len(work.validation[1])
    for name, value in first["state"].items():
        assert torch.equal(second["state"][name], value), name

    work.train, work.model = [], copy.deepcopy(work.model)
    work.model.load_state_dict(first["state"])
    alone = in_one_process(work)
    truth = truth_of(work.truth.tokens, shifted(alone["detections"]))
    expected = score_detections(truth, table_of(alone["detections"])).as_dict()
    assert 0.05 < expected["mAP"] < 0.95
    for result in (first, second):
        found = score_detections(truth, table_of(result["detections"])).as_dict()
        for (name, value), (same_name, same) in zip(numbers(expected), numbers(found), strict=True):
            assert name == same_name and same == (None if value is None else pytest.approx(value, abs=1e-6)), name
