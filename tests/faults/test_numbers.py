"""Numbers that are not finite, half precision, and determinism, in real trainings of the real model."""

import json
import math
import os
import pty
import select
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from src import replay, train
from src.assembly import build_datamodule, build_module, data_root
from src.config import compose_config, restore_config
from src.data.datamodule import in_stream
from src.data.frame_loader import collate
from src.errors import CheckpointError, ConfigError, DivergedError
from src.models.detector import Objective
from src.models.horizon3d.model import Horizon3D
from src.ops import products
from src.ops.precision import computing
from src.reliability.checkpoints import read_checkpoint
from src.reliability.nonfinite import read_dump, step_seed, write_dump
from src.structures.batch import FrameBatch
from src.structures.ray_bundle import RayBundle
from src.training.module import TrainingModule
from src.training.trainer_config import OnNonfinite
from tests.running import command

ROOT = Path(__file__).resolve().parents[2]
SMALL = (
    "scale=debug", "trainer=cpu", "trainer.num_pictures=0", "data.num_workers=0",
    "data.world.num_train_scenes=1", "data.world.num_val_scenes=1", "data.world.key_frames_per_scene=4",
)  # fmt: skip
PHASES = {"phase1": ("phase=phase1",), "phase2": ("phase=phase2", "phase.init_from=null")}


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """Eight frames."""
    config, _ = compose_config([*SMALL, f"paths.outputs={tmp_path_factory.mktemp('world')}"])
    return data_root(config)


@pytest.fixture(scope="module")
def load(world, tmp_path_factory):
    """(overrides -> an untrained module, its configuration, and two consecutive batches)."""
    outputs = tmp_path_factory.mktemp("outputs")

    def build(*overrides, seed=0):
        config, tree = compose_config(
            [*SMALL, "data.split=train", f"data.root={world}", f"paths.outputs={outputs}", *overrides]
        )
        torch.manual_seed(seed)
        datamodule = build_datamodule(config, world)
        module = build_module(config, tree, datamodule).train()
        frames = [datamodule.reader.read(sample, None) for sample in range(2)]
        if config.phase.temporal:
            frames = [in_stream(frame, 0, number == 0) for number, frame in enumerate(frames)]
        return module, tree, [collate([frame]) for frame in frames]

    return build


@pytest.fixture
def dump(load, tmp_path):
    """A dump of phase 2's second step as the trainer leaves it, before its fault is in it."""

    def write(poison=lambda batch: None, *overrides):
        module, tree, (first, batch) = load(*PHASES["phase2"], *overrides)
        with torch.no_grad():
            module.run(first)
        poison(batch)
        module._before_step = list(module.memories)
        return write_dump(
            tmp_path, module.model, tree, batch, global_step=1, epoch=0, rank=0, world_size=1,
            seed=step_seed(0, 1, 0), memories=module.memories_before_step(), found="step 1: as the test wants it",
        )  # fmt: skip

    return write


def spoil_a_point(batch):
    """The nearest one, which surely lies on the grid."""
    batch.radar_points[batch.radar_points[:, :2].norm(dim=1).argmin(), 3] = math.nan


# ---------------------------------------------------------------- what a user sees


@pytest.mark.slow
@pytest.mark.parametrize("phase", PHASES)
def test_training_continues_without_a_broken_radar_point(world, tmp_path, monkeypatch, phase):
    """One step of a whole command meets a point that is not a number; the step is replayed from what it left."""

    def poisoned(self, batch, batch_idx, original=TrainingModule.training_step):
        if self.trainer.global_step == 1:
            spoil_a_point(batch)
        return original(self, batch, batch_idx)

    monkeypatch.setattr(TrainingModule, "training_step", poisoned)
    overrides = [*SMALL, *PHASES[phase], f"data.root={world}", "phase.epochs=2"]
    with pytest.raises(DivergedError, match=r"step 1, epoch \d: loss terms .*nan.*run it again"):
        train.main([*overrides, f"paths.outputs={tmp_path / 'stopped'}"])
    train.main([*overrides, f"paths.outputs={tmp_path / 'skipped'}", "trainer.on_nonfinite=skip"])
    (stopped,), (folder,) = ((tmp_path / name).glob("horizon3d-*") for name in ("stopped", "skipped"))
    assert stopped.name == folder.name  # the policy is no part of a run's identity
    record = json.loads((folder / "run.json").read_text())
    assert record["skipped_steps"] == 1 and record["steps"] > 2
    weights = read_checkpoint(folder / "checkpoints" / "last.ckpt")["state_dict"]
    assert all(bool(torch.isfinite(value).all()) for value in weights.values())
    assert len(list(folder.glob("nonfinite-step000001-rank0.pt"))) == 1


@pytest.mark.slow
def test_the_commands_of_a_user(world, tmp_path):
    """An exploding weight of a term ends the command with code 5, and what it prints may be typed as it stands."""
    overrides = (*SMALL, f"data.root={world}", f"paths.outputs={tmp_path}", "model.loss.box_weight=1e39")
    told = command("train", *overrides, expect=5)
    assert "loss terms {'box': inf, 'total': inf} of rank 0 are not finite" in told.stderr
    typed = told.stderr.partition("python -m src.replay ")[2].split()[0]
    screen, code = in_terminal("replay", typed, "trainer.accelerator=cpu", answers=["p error", "q"])
    assert code == 5 and "box                  inf   <- not finite" in screen and "(Pdb)" in screen, screen[-3000:]


def in_terminal(module, *overrides, answers):
    """A command as in a terminal, with something typed at each prompt of the debugger: (screen, exit code)."""
    ours, theirs = pty.openpty()
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    line = [sys.executable, "-m", f"src.{module}", *overrides]
    process = subprocess.Popen(line, cwd=ROOT, stdin=theirs, stdout=theirs, stderr=theirs, env=environment)
    os.close(theirs)
    screen, deadline = "", time.monotonic() + 300
    answers = list(answers)
    try:
        while time.monotonic() < deadline:
            if select.select([ours], [], [], 1.0)[0]:
                try:
                    piece = os.read(ours, 4096)
                except OSError:  # its end has closed
                    break
                if not piece:
                    break
                screen += piece.decode(errors="replace")
            if answers and screen.count("(Pdb)") > screen.count("\x00answered"):
                os.write(ours, f"{answers.pop(0)}\n".encode())
                screen += "\x00answered"
        return screen.replace("\x00answered", ""), process.wait(timeout=30)
    finally:
        process.kill()
        os.close(ours)


# ---------------------------------------------------------------- replay


def replayed(path, capsys, *overrides):
    with pytest.raises(DivergedError) as caught:
        replay.main([f"checkpoint={path}", "trainer.accelerator=cpu", *overrides])
    return capsys.readouterr().out, str(caught.value)


def test_broken_inputs_of_past_frames_and_rays_are_named():
    eye, one = torch.eye(4)[None], torch.tensor([[1.0, 0.0, 0.0]])
    numbers = torch.ones(1)
    rays = RayBundle(one, one, numbers * torch.nan, numbers, numbers * torch.nan, *torch.zeros(2, 1, dtype=torch.int64))
    past = FrameBatch(["before"], torch.zeros(1).double(), eye.double() * torch.nan, eye)
    batch = FrameBatch(["now"], torch.zeros(1).double(), eye.double(), eye, rays=rays, past=(past,))
    assert list(replay.describe_inputs(batch)) == [
        "input: global_from_ego of before is not finite",
        "input: ranges of the rays of now are not finite",  # speeds may be unknown
    ]


@pytest.mark.slow
def test_a_broken_input_is_reported_and_the_first_module_that_meets_it(dump, capsys):
    printed, error = replayed(dump(spoil_a_point), capsys)
    assert "input: radar point " in printed and "rcs nan" in printed and "step 1: as the test wants it" in printed
    assert "total                nan   <- not finite" in printed
    assert error.startswith("the first that is not finite: the output of radar_encoder"), error


@pytest.mark.slow
def test_an_infinite_gradient_of_a_finite_loss_is_reported(dump, capsys, monkeypatch):
    """The root of zero adds nothing to the loss, and its derivative is infinite."""

    def loss(self, output, batch, original=Horizon3D.loss):
        bias = next(self.head.parameters())
        terms, diagnostics = original(self, output, batch)
        return Objective(terms | {"total": terms["total"] + (bias - bias.detach()).sqrt().sum()}, diagnostics)

    monkeypatch.setattr(Horizon3D, "loss", loss)
    printed, error = replayed(dump(), capsys)
    assert "<- not finite" not in printed and "the gradients of 1 of " in printed and "are not: head." in printed
    assert "not finite" in error


@pytest.mark.slow
def test_a_replay_says_where_the_numbers_are_finite(dump, capsys):
    """The memory and the seed are the step's: the loss is that of the step, to the bit."""
    path = dump()
    replay.main([f"checkpoint={path}", "trainer.accelerator=cpu"])
    first = capsys.readouterr().out
    replay.main([f"checkpoint={path}", "trainer.accelerator=cpu"])
    assert capsys.readouterr().out == first and "All numbers are finite this time." in first
    content = torch.load(path, weights_only=True)
    assert content["horizon3d"]["step"]["memories"]
    content["horizon3d"]["step"]["memories"] = []
    torch.save(content, path)
    replay.main([f"checkpoint={path}", "trainer.accelerator=cpu"])
    assert capsys.readouterr().out != first


@pytest.mark.slow
def test_a_replay_keeps_the_statistics_that_its_training_keeps(dump):
    path = dump(lambda batch: None, "phase.frozen_statistics=true")
    content, batch = read_dump(path)
    config = restore_config(content["horizon3d"]["config"], [])
    module = replay.Step(path, config, content, batch, torch.device("cpu")).build()
    assert module.frozen_norms and not any(norm.training for norm in module.frozen_norms)


def test_a_replay_needs_a_dump(tmp_path):
    with pytest.raises(ConfigError, match="checkpoint=PATH"):
        replay.main(["scale=debug"])
    with pytest.raises(CheckpointError, match="does not exist"):
        replay.main([f"checkpoint={tmp_path / 'none.pt'}"])


# ---------------------------------------------------------------- configuration


@pytest.mark.slow
def test_checkpoints_from_before_the_keys_load():
    _, tree = compose_config(["scale=debug", "trainer.log_every_steps=3"])
    for key in ("on_nonfinite", "deterministic"):
        del tree["trainer"][key]
    config = restore_config(tree, [])
    assert config.trainer.on_nonfinite is OnNonfinite.stop and config.trainer.deterministic is False
    assert config.trainer.log_every_steps == 3
    assert restore_config(tree, ["trainer.on_nonfinite=skip"]).trainer.on_nonfinite is OnNonfinite.skip
    with pytest.raises(CheckpointError, match="nonsense"):
        restore_config(tree | {"trainer": tree["trainer"] | {"nonsense": 1}}, [])


def test_another_policy_is_refused():
    with pytest.raises(ConfigError, match=r"(?s)trainer.on_nonfinite.*stop, ?skip|stop.*skip"):
        compose_config(["scale=debug", "trainer.on_nonfinite=ignore"])


# ---------------------------------------------------------------- half precision


def steps(module, batches, precision="32-true"):
    """(loss terms, all gradients) of consecutive steps from the same weights and seeds."""
    for number, batch in enumerate(batches):
        module.zero_grad()
        torch.manual_seed(7 + number)
        with computing(precision, torch.device("cpu")):
            terms = module.model.loss(module.run(batch), batch).terms
        terms["total"].backward()
        gradients = [p.new_zeros(p.shape) if p.grad is None else p.grad for p in module.model.parameters()]
        joined = torch.cat([gradient.flatten() for gradient in gradients])
        yield {name: float(value.detach()) for name, value in terms.items()}, joined.clone()


MODELS = PHASES | {"dense": ("model=dense_bev", *PHASES["phase2"])}


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["bf16-mixed", "bf16-products"])
@pytest.mark.parametrize("name", MODELS)
def test_half_precision_is_as_near_as_its_digits_allow(load, name, precision, monkeypatch):
    """The loss within 3 %, its terms within 8 % or thrice what half a digit of the weights moves them, as the gradient.

    bfloat16 has 8 bits: a rounding moves a number by up to 2^-9 = 0.2 %, and some forty layers one after the other, by
    chance up and down, by 1.2 %. A term moves further where one of its few cells or Gaussians is chosen otherwise.
    The gradient of a fresh model depends on such choices far more than on digits, so that it is measured against
    float32 with weights moved by up to 2^-9, and so is a term; half precision rounds activations and their gradients
    too: three times.
    """
    monkeypatch.setattr(products, "multiplies_bfloat16", lambda: True)
    monkeypatch.setattr(products, "LEAST_ROWS", 0)
    monkeypatch.setattr(products, "LEAST_WIDTHS", (8, 8))  # those of this small model
    module, _, batches = load(*MODELS[name])
    plain = list(steps(module, batches))
    half = list(steps(load(*MODELS[name])[0], batches, precision))
    moved, _, _ = load(*MODELS[name])
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for parameter in moved.model.parameters():
            parameter.mul_(1 + 2.0**-9 * (2 * torch.rand(parameter.shape, generator=generator) - 1))
    moved = list(steps(moved, batches))
    for (terms, gradient), (rounded, its_gradient), (shaken, moved_gradient) in zip(plain, half, moved, strict=True):
        assert rounded["total"] != terms["total"]
        assert rounded["total"] == pytest.approx(terms["total"], rel=0.03)
        for term, value in terms.items():
            allowed = max(0.08 * abs(value), 3 * abs(shaken[term] - value), 1e-6)
            assert abs(rounded[term] - value) <= allowed, (term, value, rounded[term], shaken[term])
        sensitivity = float((moved_gradient - gradient).norm() / gradient.norm())
        assert float((its_gradient - gradient).norm() / gradient.norm()) < 3 * sensitivity, sensitivity


# ---------------------------------------------------------------- determinism


@pytest.mark.slow
@pytest.mark.parametrize("phase", PHASES)
def test_two_runs_are_identical(world, tmp_path, phase):
    """On the CPU in either mode: no operation of a training is one that torch knows to differ from run to run."""
    results = []
    for name, mode in (("one", "true"), ("two", "true"), ("default", "false")):
        outputs = tmp_path / name
        train.main(
            [*SMALL, *PHASES[phase], f"data.root={world}", f"paths.outputs={outputs}", f"trainer.deterministic={mode}"]
        )
        assert torch.are_deterministic_algorithms_enabled() == (mode == "true")
        (folder,) = outputs.glob("horizon3d-*")
        weights = read_checkpoint(folder / "checkpoints" / "last.ckpt")["state_dict"]
        results.append((weights, [(folder / file).read_text() for file in ("metrics.csv", "metrics.json")]))
    torch.use_deterministic_algorithms(False)
    for weights, files in results[1:]:
        assert files == results[0][1]
        assert weights.keys() == results[0][0].keys()
        assert all(torch.equal(value, results[0][0][key]) for key, value in weights.items())
