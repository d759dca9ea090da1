"""Two processes train and score as one with the same batch does (CPU, gloo)."""

import copy
import csv
import os
import signal
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import lightning as L
import numpy as np
import pytest
import torch
from torch.nn.parallel import DistributedDataParallel
from torch.utils.data import DataLoader

from src.benchmark.suite_metric import random_problem
from src.data.datamodule import in_stream
from src.data.frame_loader import collate
from src.errors import InterruptedRunError
from src.metrics.bootstrap import with_intervals
from src.metrics.detection import score_detections
from src.models.horizon3d.kggi import Initialization
from src.reliability.processes import (
    SharedStatistics,
    build_strategy,
    gather_by_rank,
    process_group,
    running_statistics,
)
from src.structures.detections import DetectionTable, EvaluationSet
from src.training.evaluator import DetectionEvaluator
from src.training.module import TrainingModule
from src.training.optim import OptimConfig
from src.training.run_folder import RunFolder
from src.training.temporal_module import TemporalModule
from tests.evaluation_sets import set_of
from tests.models.frames import make_batch
from tests.models.horizon3d.small_model import dptf_config, make_model
from tests.models.surroundings import DIAGONALS
from tests.training.toys import STEPS as TOY_STEPS
from tests.training.toys import Positions, toy_batch, toy_module, train_toy
from tests.training.two_ranks import become, spawn_two

STREAMS, STEPS = 4, 3
FIRST_RANK, SECOND_RANK = (0, 1), (2, 3)
COLUMNS = tuple(DetectionTable.__dataclass_fields__)


@dataclass
class Work:
    """What one process does, as values that travel to it."""

    model: torch.nn.Module
    train: list[list]  # per step and stream, a batch of one
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

    def objective(self, batch):
        objective = super().objective(batch)
        self.totals = [*self.totals, float(objective.terms["total"].detach())]
        return objective

    def configure_optimizers(self):
        optimizer = torch.optim.SGD(self.model.parameters(), lr=1e-3)
        constant = torch.optim.lr_scheduler.ConstantLR(optimizer, factor=1.0)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": constant, "interval": "step"}}


def work_as(rank, port, world_size, work):
    """Train three steps and validate, as rank `rank` of `world_size`; the result goes to a file."""
    become(rank, world_size, port)
    optim = OptimConfig(
        lr=1e-3, weight_decay=0.0, clip_norm=35.0, peak_lr_ratio=1.0, final_lr_ratio=1.0, rise_fraction=0.5,
        betas=[0.9, 0.99], cycled_beta1=None, ema_decay=None,
    )  # fmt: skip
    module = Module(copy.deepcopy(work.model), optim, 1.0, DetectionEvaluator(work.truth), 0, {})
    module.eval_norms = work.eval_norms
    streams = (FIRST_RANK, SECOND_RANK)[rank] if world_size > 1 else range(STREAMS)
    train = [collate([frames[stream] for stream in streams]) for frames in work.train]
    validation = work.validation[rank] if world_size > 1 else [batch for part in work.validation for batch in part]
    with process_group("cpu", world_size):
        trainer = L.Trainer(
            max_epochs=1, accelerator="cpu", devices=world_size, strategy=build_strategy("cpu", world_size),
            callbacks=[SharedStatistics()], logger=False, enable_checkpointing=False, enable_progress_bar=False,
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
        "detections": {name: torch.from_numpy(getattr(module.evaluator.detections, name)) for name in COLUMNS},
    }
    torch.save(result, work.folder / f"{world_size}-{rank}.pt")


def in_one_process(work):
    work_as(0, 0, 1, work)
    return torch.load(work.folder / "1-0.pt", weights_only=True)


def in_two_processes(work):
    """Both ranks' results."""
    spawn_two(work_as, 2, work)
    return [torch.load(work.folder / f"2-{rank}.pt", weights_only=True) for rank in range(2)]


@pytest.fixture
def frames():
    """Batches of one: (stream, step, points, boxes, cameras) -> that stream's frame of a step of half a second."""

    def build(stream, step, points=60, boxes=5, cameras=True):
        frame = make_batch((points,), (boxes,), 10 * step + stream, headings=DIAGONALS, origin=(0.0, 0.0))
        frame = replace(
            frame,
            tokens=[f"{stream}/{step}"],
            timestamps_s=torch.tensor([0.5 * step], dtype=torch.float64),
            image_valid=frame.image_valid & cameras,
        )
        return in_stream(frame, stream, step % 10 == 0)

    return build


@pytest.fixture
def work(frames, tmp_path):
    """Three steps in which one process or the other, or a stream, lacks what the other has."""
    model = make_model(dptf=dptf_config(), initialization=Initialization.keypoint)
    model.head.config = replace(model.head.config, score_threshold=0.05)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in model.parameters():  # what starts at zero would hide the parts behind it
            parameter += 0.03 * torch.randn(parameter.shape, generator=generator)
        for head in (model.kggi.objectness, model.kggi.camera_head.keypoint):
            head[-1].weight *= 20.0  # scores so far apart that rounding never changes which keypoints are the best
    nothing = {"points": 0, "cameras": False}  # no keypoint, hence no Gaussian at all
    lacking = [
        {stream: {"boxes": 0} for stream in SECOND_RANK},
        {0: {"points": 0}, 1: {"points": 0, "boxes": 1}, 3: {"boxes": 0}},
        {stream: nothing for stream in SECOND_RANK},
    ]
    train = [
        [frames(stream, step, **lacks.get(stream, {})) for stream in range(STREAMS)]
        for step, lacks in enumerate(lacking)
    ]
    validation = [
        [collate([frames(0, 10), frames(1, 10)]), collate([frames(0, 11)]), collate([frames(0, 12, points=0)])],
        [collate([frames(2, 10)])],
    ]
    tokens = [token for part in validation for batch in part for token in batch.tokens]
    return Work(model, train, validation, truth_of(tokens, DetectionTable.empty()), tmp_path)


def truth_of(tokens, boxes):
    return set_of(boxes, tokens)


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


def statistics_as(rank, port, folder):
    """What a norm of each rank holds before and after the callback, and once more after it resumes with DDP around."""
    become(rank, 2, port)
    with process_group("cpu", 2):
        module = toy_module(TrainingModule)
        module.model.norm = torch.nn.BatchNorm1d(2)
        module.model.norm.running_mean += torch.tensor([rank, 3.0])
        module.model.norm.running_var *= 1.0 + 4.0 * rank
        state = module.rank_state()
        SharedStatistics().on_train_epoch_end(None, module)
        shared = copy.deepcopy(running_statistics(module))
        module._trainer = SimpleNamespace(global_rank=rank, world_size=2)
        module.on_load_checkpoint({"horizon3d": {"ranks": gather_by_rank(state)}})
        DistributedDataParallel(module, **build_strategy("cpu", 2)._ddp_kwargs)
        module.on_fit_start()
        torch.save((state["statistics"], shared, running_statistics(module)), folder / f"{rank}.pt")


@pytest.mark.slow
def test_ranks_share_the_mean_of_their_statistics_and_resume_with_their_own(tmp_path):
    spawn_two(statistics_as, tmp_path)
    for rank in range(2):
        own, shared, resumed = torch.load(tmp_path / f"{rank}.pt", weights_only=True)
        assert {name: value.tolist() for name, value in shared.items()} == {
            "model.norm.running_mean": [0.5, 3.0],
            "model.norm.running_var": [3.0, 3.0],
        }
        assert own["model.norm.running_mean"].tolist() == [rank, 3.0]
        assert {name: value.tolist() for name, value in resumed.items()} == {
            "model.norm.running_mean": [rank, 3.0],
            "model.norm.running_var": [1.0 + 4.0 * rank] * 2,
        }


# ---------------------------------------------------------------- resuming with another number of processes

STOP_AT = TOY_STEPS + 1  # in the middle of the second epoch
PROBLEM = 7, 20, 40, 3  # samples, which two ranks share as five and two; annotations, boxes, seed


class Single(TrainingModule):
    """Trains on single frames, stops where asked to, and validates with boxes that are given."""

    stop_at = None

    def training_step(self, batch, batch_idx):
        if self.trainer.global_step == self.stop_at:
            os.kill(os.getpid(), signal.SIGTERM)
        return super().training_step(batch, batch_idx)

    def validation_step(self, batch, batch_idx):
        evaluation_set, boxes = random_problem(*PROBLEM)
        sample = int(batch.tokens[0].split()[1])
        self.evaluator.boxes[sample] = boxes[boxes.samples == sample]


class Shared:
    """This rank's part of the four streams of (epoch, step)."""

    def __init__(self, streams):
        self.streams = streams

    def __getitem__(self, key):
        epoch, step = key
        numbers = {stream: 1000 * stream + 10 * epoch + step for stream in self.streams}
        return collate([toy_batch([stream], [False], number=number) for stream, number in numbers.items()])


class SharedData(L.LightningDataModule):
    """The same batches however many ranks share them; validation in unequal parts."""

    def train_dataloader(self):
        streams = (FIRST_RANK, SECOND_RANK)[self.trainer.global_rank] if self.trainer.world_size > 1 else range(STREAMS)
        return DataLoader(Shared(streams), batch_size=None, sampler=Positions(self.trainer, []))

    def val_dataloader(self):
        samples = range(PROBLEM[0])
        if self.trainer.world_size > 1:
            samples = (samples[:5], samples[5:])[self.trainer.global_rank]
        return DataLoader([toy_batch([0], [True], sample) for sample in samples], batch_size=None)


def train_single(path, world_size, stop_at=None):
    """Train three epochs in a folder, from its newest checkpoint where there is one."""
    module = toy_module(Single)
    module.model.dropout.p = 0.0  # its draws are a rank's own
    module.evaluator, module.stop_at = DetectionEvaluator(random_problem(*PROBLEM)[0]), stop_at
    try:
        train_toy(RunFolder(path.parent, path.name), module, SharedData(), ranks=world_size)
    except InterruptedRunError:
        assert stop_at is not None and module.trainer.global_step == stop_at + 1
    return module.evaluator.scores and module.evaluator.as_dict()


def go_on_as(rank, port, world_size, folder):
    """As one of two: finish what one process began, and begin what one process will finish."""
    become(rank, world_size, port)
    with process_group("cpu", world_size):
        scores = train_single(folder / "one, then two", world_size)
        train_single(folder / "two, then one", world_size, stop_at=STOP_AT)
    torch.save(scores, folder / f"scores {rank}.pt")


def epochs_of(path):
    """The log's rows of epochs: their means and scores by name."""
    with open(path / "metrics.csv", newline="") as file:
        rows = [{name: float(value) for name, value in row.items() if value} for row in csv.DictReader(file)]
    return [row for row in rows if "loss/total" in row or "val/mAP" in row]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Checkpoint directory")
def test_a_run_resumes_with_another_number_of_processes(tmp_path):
    """From one to two and from two to one in the middle of an epoch: its means are those of one process all along."""
    scores = train_single(tmp_path / "one", 1)
    train_single(tmp_path / "one, then two", 1, stop_at=STOP_AT)
    spawn_two(go_on_as, 2, tmp_path)
    assert scores == with_intervals(score_detections(*random_problem(*PROBLEM)))
    assert train_single(tmp_path / "two, then one", 1) == scores
    assert 0.02 < scores["mAP"] < 0.98
    for rank in range(2):
        assert torch.load(tmp_path / f"scores {rank}.pt", weights_only=True) == scores  # to the last digit

    expected = epochs_of(tmp_path / "one")
    assert len(expected) >= 3 and {"loss/total", "loss/near", "state/gradient_norm"} <= set(expected[1])
    for name in ("one, then two", "two, then one"):
        found = epochs_of(tmp_path / name)
        assert len(found) == len(expected)
        for row, same in zip(found, expected, strict=True):
            assert set(row) == set(same)
            for key, value in same.items():
                exact = key.startswith("val/") or key in ("epoch", "step")
                # The spread of a batch is a rank's own; everything else is a sum over frames.
                tolerance = 0.0 if exact else 1e-5
                assert key == "state/spread" or row[key] == pytest.approx(value, rel=tolerance, abs=0.0), (name, key)
