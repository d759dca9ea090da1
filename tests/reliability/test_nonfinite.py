"""Steps whose numbers are not finite: detected, reported, dumped, skipped, on a model of a few parameters."""

import copy
import csv
import logging
import math
import os
import re
import time
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from torch import nn

from src.errors import CheckpointError, DivergedError, InterruptedRunError
from src.models.detector import Objective
from src.reliability import nonfinite
from src.reliability.checkpoints import AtomicCheckpointIO, read_checkpoint
from src.reliability.nonfinite import describe_gradients, finite_everywhere, gradient_norm, read_dump, write_dump
from src.reliability.processes import process_group
from src.training.fit import MovingAverage
from src.training.module import TrainingModule
from src.training.run_folder import RunFolder
from src.training.temporal_module import TemporalModule
from tests.ray_bundles import rays_to
from tests.training.toys import STEPS, ToyData, toy_batch, toy_module, train_toy
from tests.training.two_ranks import become, spawn_two

EPOCHS = 2
BAD_STEP = 4  # the second of the second epoch, so that its streams have memory


class Faulty(TemporalModule):
    """Has a batch norm, faults in some steps, and notes what each step began and ended with."""

    fault, bad_steps, stop_after = None, (), None

    def setup(self, stage):
        self.states = []

    def everything(self):
        optimizer = self.trainer.optimizers[0]
        return copy.deepcopy((self.model.state_dict(), [optimizer.state[p] for p in self.model.parameters()]))

    def on_train_batch_start(self, batch, batch_idx):
        if self.trainer.global_step in self.bad_steps and self.fault == "point":
            batch.radar_points[1, 3] = math.nan
        super().on_train_batch_start(batch, batch_idx)
        self.states.append(self.everything())

    def objective(self, batch):
        terms, diagnostics = super().objective(batch)
        if self.trainer.global_step in self.bad_steps:
            bias = self.model.layer.bias
            if self.fault == "weight":  # a term that explodes
                terms |= {name: terms[name] * 1e39 for name in ("near", "total")}
            if self.fault == "constant":  # infinite, with gradients that know nothing of it
                terms["total"] = terms["total"] + math.inf
            if self.fault == "gradient":  # the root of zero: nothing is added to the loss, its derivative is infinite
                terms["total"] = terms["total"] + (bias - bias.detach()).sqrt().sum()
            if self.fault == "overflow":  # every gradient is finite, the sum of their squares is not
                terms["total"] = terms["total"] + 1e30 * (bias - bias.detach()).sum()
        return Objective(terms, diagnostics)

    def on_train_batch_end(self, outputs, batch, batch_idx):
        self.states.append(self.everything())
        if self.trainer.global_step == self.stop_after:
            raise InterruptedRunError("here")


def train(path, fault=None, bad_steps=(BAD_STEP,), skip=True, stop_after=None, **options):
    """Train in a folder, from its newest checkpoint where there is one; the module, its folder, what it ended with."""
    folder, module = RunFolder(path.parent, path.name), toy_module(Faulty)
    module.model.dropout = nn.Sequential(nn.BatchNorm1d(7), module.model.dropout)
    module.fault, module.bad_steps, module.stop_after = fault, bad_steps, stop_after
    module.guard.skip = skip
    try:
        train_toy(folder, module, ToyData(), epochs=EPOCHS, **options)
    except (DivergedError, InterruptedRunError) as error:
        return module, folder, error
    return module, folder, None


def dumps(folder):
    return sorted(path.name for path in folder.path.glob("nonfinite*"))


def same(one, other):
    """Equal tensors in equal containers; NaN equals NaN."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, (list, tuple)):
        return len(one) == len(other) and all(map(same, one, other))
    return torch.equal(one, other) if isinstance(one, torch.Tensor) else one == other


WORDS = {
    "point": r"loss terms \{'near': nan, 'small': nan, 'total': nan\} of rank 0",
    "weight": r"loss terms \{'near': inf, 'total': inf\} of rank 0",
    "constant": r"loss terms \{'total': inf\} of rank 0",
    "gradient": r"the loss \(.*\) is finite, but the gradients of 1 of 4 parameters are not: layer.bias",
    "overflow": r"the loss \(.*\) is finite, but the norm of the gradients overflows; .* is 1e\+30 in layer.bias",
}


@pytest.mark.slow
@pytest.mark.parametrize("fault", WORDS)
def test_the_training_stops_at_the_step_and_says_why(tmp_path, fault):
    module, folder, error = train(tmp_path / "run", fault, skip=False)
    assert isinstance(error, DivergedError)
    message = str(error)
    assert message.startswith("step 4, epoch 1: ") and "samples of rank 0: frame 11 0, frame 11 1" in message
    assert re.search(WORDS[fault], message), message
    (name,) = dumps(folder)
    assert f"python -m src.replay checkpoint={folder.path / name}" in message
    # The weights, running statistics and optimiser are those before the step.
    assert same(module.everything(), module.states[-1])


@pytest.mark.parametrize("fault", WORDS)
def test_the_dump_holds_the_step(tmp_path, fault):
    module, folder, _ = train(tmp_path / "run", fault, skip=False)
    content, batch = read_dump(folder.path / "nonfinite-step000004-rank0.pt")
    step = content["horizon3d"]["step"]
    assert (step["global_step"], step["epoch"], step["rank"], step["world_size"]) == (4, 1, 0, 1)
    weights, _ = module.states[-1]
    assert same({key.removeprefix("model."): value for key, value in content["state_dict"].items()}, weights)
    wanted = toy_batch([0, 1], [False, False], number=11)
    if fault == "point":
        wanted.radar_points[1, 3] = math.nan
    for name in ("radar_points", "radar_batch", "streams", "starts", "global_from_ego"):
        assert torch.allclose(getattr(batch, name), getattr(wanted, name), rtol=0, atol=0, equal_nan=True), name
    assert batch.tokens == wanted.tokens and len(step["memories"]) == 1 and step["memories"][0]["streams"] == [0, 1]

    again = toy_module(TemporalModule)
    again.model.dropout = nn.Sequential(nn.BatchNorm1d(7), again.model.dropout)
    again.model.load_state_dict(weights)
    again.restore_rank({"means": {}, "memories": step["memories"]})
    torch.manual_seed(step["seed"])
    terms = again.model.loss(again.train().run(batch), batch).terms
    if fault == "gradient":  # the loss that was reported is the loss of the same memory and dropout
        assert f"{float(terms['total'].detach()):.4g}" in step["found"]
    assert torch.isfinite(terms["total"]) == (fault != "point")


@pytest.mark.slow
def test_a_skipped_step_does_not_move_the_average_of_the_weights(tmp_path, monkeypatch):
    averages, on_batch_end = [], MovingAverage.on_train_batch_end

    def watched(self, *arguments):
        on_batch_end(self, *arguments)
        averages.append({name: value.clone() for name, value in self._average_model.state_dict().items()})

    monkeypatch.setattr(MovingAverage, "on_train_batch_end", watched)
    train(tmp_path / "run", "weight", ema=0.9)
    moved = [not same(before, after) for before, after in pairwise(averages)]
    assert moved == [step != BAD_STEP for step in range(1, EPOCHS * STEPS)]


@pytest.mark.parametrize("fault", WORDS)
def test_a_skipped_step_leaves_nothing_behind(tmp_path, fault, caplog):
    with caplog.at_level(logging.WARNING):
        module, folder, error = train(tmp_path / "run", fault)
    assert error is None and module.guard.skipped_steps == 1 and module.guard.in_a_row == 0
    assert "skipped (1 so far): step 4, epoch 1" in caplog.text
    for step in range(EPOCHS * STEPS):
        before, after = module.states[2 * step : 2 * step + 2]
        assert same(before, after) == (step == BAD_STEP), step
    with folder.metrics_csv.open(newline="") as file:
        rows = list(csv.DictReader(file))
    broken = [(row["step"], name) for row in rows for name, text in row.items() if text in ("nan", "inf")]
    assert broken == ([("4", "step/near"), ("4", "step/small"), ("4", "step/total")] if fault == "point" else [])
    assert sum(bool(row.get("loss/near")) for row in rows) == EPOCHS
    weights = read_checkpoint(folder.checkpoints / "last.ckpt")["state_dict"]
    assert all(torch.isfinite(value).all() for value in weights.values() if value.is_floating_point())
    assert dumps(folder) == ["nonfinite-step000004-rank0.pt"]


def test_the_steps_behind_are_seeded_and_scheduled_as_without_the_fault(tmp_path):
    """A skipped step counts: learning rate, draws and data continue as if it had been made."""
    whole, *_ = train(tmp_path / "whole")
    skipping, *_ = train(tmp_path / "skipping", "weight", bad_steps=(0,))
    assert skipping.trainer.global_step == whole.trainer.global_step == EPOCHS * STEPS
    assert skipping.trainer.optimizers[0].param_groups[0]["lr"] == whole.trainer.optimizers[0].param_groups[0]["lr"]
    assert not same(whole.everything()[0], skipping.everything()[0])


def test_streams_begin_anew_after_a_skipped_step():
    module = toy_module()
    module.run(toy_batch([5, 3], [True] * 2))
    module.run(toy_batch([1, 2], [True] * 2))
    module.forget_step(toy_batch([5, 3], [False] * 2))
    assert module.select_memory(toy_batch([5, 3], [False] * 2)) is None
    assert module.select_memory(toy_batch([1, 2], [False] * 2)) is not None


def test_training_gives_up_after_too_many_in_a_row(tmp_path, monkeypatch):
    monkeypatch.setattr("src.reliability.nonfinite.MAX_IN_A_ROW", 2)
    module, folder, error = train(tmp_path / "alternating", "point", bad_steps=(0, 1, 3, 4))
    assert error is None and module.guard.skipped_steps == 4
    assert dumps(folder) == ["nonfinite-step000000-rank0.pt", "nonfinite-step000003-rank0.pt"]  # the first of each row
    module, folder, error = train(tmp_path / "always", "point", bad_steps=range(1, 6))
    assert "step 3" in str(error) and "More than 2 steps in a row" in str(error)
    assert dumps(folder) == ["nonfinite-step000001-rank0.pt"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Checkpoint directory")
@pytest.mark.parametrize("stop_after", [2, 4, 5])
def test_a_resumed_run_skips_the_same_steps(tmp_path, stop_after):
    options = {"fault": "point", "bad_steps": (1, 3, 4), "every_steps": 1}
    whole, folder, _ = train(tmp_path / "whole", **options)
    train(tmp_path / "stopped", stop_after=stop_after, **options)
    resumed, other, error = train(tmp_path / "stopped", **options)
    assert error is None and resumed.guard.state() == whole.guard.state() == [3, 0]
    assert same(resumed.everything(), whole.everything())
    assert other.metrics_csv.read_text() == folder.metrics_csv.read_text()


def test_the_newest_dumps_of_a_rank_are_kept(tmp_path):
    module, batch = toy_module(), toy_batch([0, 1], [True] * 2)
    for step in (7, 8, 9, 1000000):
        for rank in (0, 1):
            named = {"global_step": step, "rank": rank, "epoch": 0, "world_size": 2, "seed": 1, "memories": []}
            write_dump(tmp_path, module.model, {}, batch, **named, found="")
    steps = ("000008", "000009", "1000000")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        f"nonfinite-step{step}-rank{rank}.pt" for step in steps for rank in (0, 1)
    )


def test_a_dump_is_kept_whatever_the_clock_said_before(tmp_path):
    module, batch = toy_module(), toy_batch([0, 1], [True] * 2)
    named = {"rank": 0, "epoch": 0, "world_size": 1, "seed": 1, "memories": [], "found": ""}
    ahead = time.time() + 3600
    for step in (1, 2, 3):
        path = write_dump(tmp_path, module.model, {}, batch, global_step=step, **named)
        os.utime(path, (ahead + step, ahead + step))
    newest = write_dump(tmp_path, module.model, {}, batch, global_step=4, **named)
    assert {path.name[14:20] for path in tmp_path.iterdir()} == {"000002", "000003", "000004"} and newest.is_file()


def test_a_disk_that_refuses_the_dump_does_not_hide_the_fault(tmp_path, monkeypatch, caplog):
    def refuse(*arguments, **named):
        raise CheckpointError("no space left")

    with monkeypatch.context() as patch, caplog.at_level(logging.WARNING):
        patch.setattr(nonfinite.AtomicCheckpointIO, "save_checkpoint", refuse)
        _, folder, error = train(tmp_path / "run", "point", bad_steps=(0,), skip=False)
    assert isinstance(error, DivergedError) and "src.replay" not in str(error) and "near" in str(error)
    assert "no space left" in caplog.text and not dumps(folder)


def test_a_dump_keeps_lidar_past_frames_and_rays(tmp_path):
    def cloud(count):
        points, owners = torch.randn(count, 5), torch.arange(count) % 2
        own = {"lidar_origins": torch.randn(count, 3), "lidar_speeds": torch.randn(count)}
        return {"lidar_points": points, "lidar_batch": owners.sort()[0], **own}

    bare = replace(toy_batch([3, 7], [True, False]), radar_points=None, radar_batch=None)
    past, two = replace(bare, streams=None, starts=None, **cloud(3)), torch.arange(2)
    rays = rays_to(torch.randn(2, 3), steps=two, batch=two)
    batch = replace(bare, **cloud(4), past=(past, replace(past, **cloud(0))), rays=rays)
    named = {"global_step": 1, "rank": 0, "epoch": 0, "world_size": 1, "seed": 1, "memories": [], "found": ""}
    _, found = read_dump(write_dump(tmp_path, toy_module().model, {}, batch, **named))
    assert found.radar_points is None and [len(frame.lidar_points) for frame in found.past] == [3, 0]
    for one, other in ((found, batch), (found.past[0], past)):
        for name in ("lidar_points", "lidar_batch", "lidar_origins", "lidar_speeds", "global_from_ego"):
            assert torch.equal(getattr(one, name), getattr(other, name))
    assert torch.equal(found.rays.points, rays.points) and torch.equal(found.rays.steps, rays.steps)


def test_other_files_are_no_dumps(tmp_path):
    path = tmp_path / "last.ckpt"
    content = {"state_dict": {"model.a": torch.zeros(1)}, "horizon3d": {"config": {}}}
    AtomicCheckpointIO().save_checkpoint(content, path)
    with pytest.raises(CheckpointError, match="no dump of a step"):
        read_dump(path)
    write_dump(
        tmp_path, toy_module().model, {}, toy_batch([0, 1], [True] * 2), global_step=1, rank=0, epoch=0, world_size=1,
        seed=1, memories=[], found="",
    )  # fmt: skip
    path = tmp_path / "nonfinite-step000001-rank0.pt"
    content = torch.load(path, weights_only=True)
    content["horizon3d"]["step"]["batch"]["radar_points"] = torch.zeros(3, 2)
    AtomicCheckpointIO().save_checkpoint(content, path)
    with pytest.raises(CheckpointError, match="radar_points"):
        read_dump(path)


def test_clipping_is_that_of_torch():
    """Norm and clipping in two parts give bit for bit what `clip_grad_norm_` gives."""
    torch.manual_seed(0)
    layers = [nn.Linear(50, 50), nn.Linear(50, 3)]
    models = [nn.Sequential(*copy.deepcopy(layers)) for _ in range(2)]
    x = torch.randn(8, 50)
    for model in models:
        (100 * model(x)).square().sum().backward()
    expected = torch.nn.utils.clip_grad_norm_(models[0].parameters(), 35.0)
    module = toy_module(TrainingModule)
    module.model = models[1]
    module.clip_gradients_or_skip(toy_batch([0, 1], [True] * 2), Objective({"total": torch.tensor(1.0)}, {}))
    for one, other in zip(models[0].parameters(), models[1].parameters(), strict=True):
        assert torch.equal(one.grad, other.grad)
    assert float(module.means.compute(torch.device("cpu"))["state/gradient_norm"]) == float(expected) > 35.0


def test_parameters_are_named():
    model = nn.Sequential(*[nn.Linear(2, 2) for _ in range(4)])
    for parameter in model.parameters():
        parameter.grad = torch.zeros_like(parameter)
    model[3].weight.grad[0, 1] = -math.inf
    assert describe_gradients(model).endswith("1 of 8 parameters are not: 3.weight")
    for parameter in model.parameters():
        parameter.grad.fill_(math.nan)
    assert describe_gradients(model).endswith("0.weight, 0.bias, 1.weight, 1.bias, 2.weight and 3 more")
    assert not finite_everywhere(gradient_norm(model)) and finite_everywhere(torch.tensor(1e30), torch.tensor(0.0))


def as_rank(rank, port, path):
    """Train as one of two ranks, of which the second alone meets each fault; what it ended with goes to a file."""
    become(rank, 2, port)
    with process_group("cpu", 2):
        for fault, skip in FAULTS_OF_RANKS:
            bad_steps = (BAD_STEP,) if rank == 1 else ()
            folder = path / fault
            module, _, error = train(folder / "run", fault, bad_steps, skip, ranks=2)
            weights = module.model.layer.state_dict()
            said = {"message": str(error), "weights": weights, "counts": module.guard.state()}
            torch.save(said, folder / f"{rank}.pt")


FAULTS_OF_RANKS = [("point", False), ("gradient", False), ("constant", True)]


@pytest.fixture(scope="module")
def both_ranks(tmp_path_factory):
    """What two ranks say of each fault on one of them, a folder each."""
    path = tmp_path_factory.mktemp("ranks")
    for fault, _ in FAULTS_OF_RANKS:
        (path / fault).mkdir()
    spawn_two(as_rank, path)
    return path


@pytest.mark.slow
@pytest.mark.parametrize(("fault", "skip"), FAULTS_OF_RANKS)
def test_ranks_agree(both_ranks, fault, skip):
    """What one of two ranks meets, both stop at with the same words, or both skip; nobody waits for the other."""
    tmp_path = both_ranks / fault
    first, second = (torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in range(2))
    assert first["message"] == second["message"] and same(first["weights"], second["weights"])
    folder = tmp_path / "run"
    names = sorted(path.name for path in folder.glob("nonfinite*"))
    if fault == "gradient":  # a mean over the ranks: nobody can tell whose it was
        assert names == [f"nonfinite-step000004-rank{rank}.pt" for rank in range(2)]
        assert "the gradients of 1 of 4" in first["message"] and "rank 0: frame" in first["message"]
    else:
        assert names == ["nonfinite-step000004-rank1.pt"]
    if skip:
        assert first["message"] == "None" and first["counts"] == second["counts"] == [1, 0]
        assert all(bool(torch.isfinite(value).all()) for value in first["weights"].values())
    elif fault == "point":
        assert "of rank 1 are not finite; samples of rank 1: frame 1011 0, frame 1011 1" in first["message"]
