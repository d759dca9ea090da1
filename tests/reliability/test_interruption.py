"""A run that was stopped or killed anywhere ends as if nothing had happened."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from src import train as train_command
from src.errors import InterruptedRunError
from src.reliability.checkpoints import AtomicCheckpointIO, read_checkpoint
from src.reliability.interruption import Interruption
from src.reliability.processes import process_group
from src.training.evaluator import DetectionEvaluator
from src.training.run_folder import RunFolder
from src.training.temporal_module import TemporalModule
from tests.faults.killing import digest, outcome
from tests.training.toys import EPOCHS, STEPS, ToyData, toy_module, train_toy
from tests.training.two_ranks import become, spawn_two


class Faulty(TemporalModule):
    """Does something at one training step, or in one validation batch."""

    at_step = at_validation = None
    fault = None
    seen = None

    def training_step(self, batch, batch_idx):
        if self.trainer.global_step == self.at_step:
            self.fault()
        self.seen.append(self.trainer.global_step)
        if self.trainer.global_rank == 1:
            self.means.update("state/of one rank", 1.0, 1)
        return super().training_step(batch, batch_idx)

    def validation_step(self, batch, batch_idx):
        if (self.trainer.current_epoch, batch_idx) == self.at_validation:
            self.fault()
        return super().validation_step(batch, batch_idx)


def train(path, *, fault=None, at_step=None, at_validation=None, **options):
    """Train in a folder, from its newest checkpoint where there is one; what the run ended with, and its module."""
    folder, module = RunFolder(path.parent, path.name), toy_module(Faulty)
    module.fault, module.at_step, module.at_validation, module.seen = fault, at_step, at_validation, []
    train_toy(folder, module, ToyData(), **options)
    return result(folder, module), module


@pytest.fixture
def run(tmp_path):
    return lambda name, **options: train(tmp_path / name, **options)


def result(folder, module):
    return {
        "weights": digest(read_checkpoint(folder.checkpoints / "last.ckpt")["state_dict"]),
        "weights in memory": digest(module.model.state_dict()),
        "log": folder.metrics_csv.read_text(),
        "scores": module.evaluator.scores.overall.headline(),
        "skipped files": dict(module.skipped.channels),
    }


def terminate():
    os.kill(os.getpid(), signal.SIGTERM)


def interrupt():
    os.kill(os.getpid(), signal.SIGINT)


class Killed(Exception):
    """Stands for kill -9."""


def kill():
    raise Killed


STOPPED_OFTEN = pytest.mark.filterwarnings("ignore:Checkpoint directory")


@pytest.mark.slow
@STOPPED_OFTEN
@pytest.mark.parametrize(("validate_every", "ema"), [(1, None), (2, 0.9)])
def test_stopped_at_every_step(run, validate_every, ema):
    options = {"validate_every": validate_every, "ema": ema}
    expected, whole = run("whole", **options)
    assert whole.seen == list(range(EPOCHS * STEPS))
    for step in range(EPOCHS * STEPS):
        name = f"stopped at {step}"
        with pytest.raises(InterruptedRunError, match="same command"):
            run(name, fault=interrupt if step % 2 else terminate, at_step=step, **options)
        found, module = run(name, **options)
        assert module.seen == list(range(step + 1, EPOCHS * STEPS))  # the running step ended, the next is the first
        assert found == expected, step


@pytest.mark.slow
@STOPPED_OFTEN
def test_stopped_again_and_again(run):
    expected, _ = run("whole")
    for step in range(EPOCHS * STEPS):
        with pytest.raises(InterruptedRunError):
            run("stopped", fault=terminate, at_step=step)
    found, module = run("stopped")  # only the results were missing
    assert found == expected and module.seen == []


@pytest.mark.slow
@STOPPED_OFTEN
@pytest.mark.parametrize("fault", ["stop", "kill"])
def test_ended_in_a_validation(run, fault):
    """The epoch's steps are not repeated; its validation is run again as a whole."""
    expected, _ = run("whole", ema=0.9)
    for epoch in range(EPOCHS):
        error, cause = (InterruptedRunError, terminate) if fault == "stop" else (Killed, kill)
        with pytest.raises(error):
            run(f"ended in {epoch}", ema=0.9, fault=cause, at_validation=(epoch, 1))
        found, module = run(f"ended in {epoch}", ema=0.9)
        assert module.seen == list(range((epoch + 1) * STEPS, EPOCHS * STEPS))
        assert found == expected, epoch


@pytest.mark.slow
@STOPPED_OFTEN
@pytest.mark.parametrize("step", [1, 2, 4, 5, 8])
def test_killed_between_checkpoints_of_steps(run, step):
    """From the newest checkpoint of every second step or of the end of an epoch, whichever is later."""
    expected, _ = run("whole", validate_every=2)
    with pytest.raises(Killed):
        run("killed", fault=kill, at_step=step, validate_every=2, every_steps=2)
    found, module = run("killed", validate_every=2, every_steps=2)
    behind = max(step // 2 * 2, step // STEPS * STEPS)
    assert module.seen == list(range(behind, EPOCHS * STEPS))
    assert found == expected


@STOPPED_OFTEN
@pytest.mark.parametrize(("validate_every", "ema"), [(1, 0.9), (2, 0.9)])
def test_only_the_results_were_missing(run, validate_every, ema):
    options = {"validate_every": validate_every, "ema": ema}
    expected, _ = run("run", **options)
    found, module = run("run", **options)
    assert module.seen == [] and found == expected


@pytest.mark.parametrize(("scores", "best_step"), [((0.1, 0.9), EPOCHS * STEPS), ((0.9, 0.1), 2 * STEPS)])
def test_the_validation_after_the_last_epoch_may_be_the_best(run, monkeypatch, tmp_path, scores, best_step):
    """Of three epochs the second is validated, and the last one at the end."""
    compute, left = DetectionEvaluator.compute, list(scores)
    monkeypatch.setattr(DetectionEvaluator, "compute", lambda self: compute(self) | {"mAP": left.pop(0)})
    run("run", validate_every=2)
    assert read_checkpoint(tmp_path / "run" / "checkpoints" / "best.ckpt")["global_step"] == best_step and not left


@STOPPED_OFTEN
def test_the_best_score_is_known_after_the_outputs_were_moved(run, monkeypatch, tmp_path):
    compute, left = DetectionEvaluator.compute, [0.9, 0.5, 0.1]
    monkeypatch.setattr(DetectionEvaluator, "compute", lambda self: compute(self) | {"mAP": left.pop(0)})
    with pytest.raises(InterruptedRunError):
        run("outputs/run", fault=terminate, at_step=STEPS)
    (tmp_path / "outputs").rename(tmp_path / "moved")
    run("moved/run")
    checkpoints = tmp_path / "moved" / "run" / "checkpoints"
    steps = {path.name: read_checkpoint(path)["global_step"] for path in checkpoints.glob("*.ckpt")}
    assert (steps["best.ckpt"], steps["last.ckpt"]) == (STEPS, EPOCHS * STEPS) and not left


@STOPPED_OFTEN
def test_the_checkpoint_is_read_once(run, monkeypatch):
    with pytest.raises(InterruptedRunError):
        run("stopped", fault=terminate, at_step=4, ema=0.9)
    load, loads = torch.load, []
    monkeypatch.setattr(torch, "load", lambda file, **options: loads.append(file.name) or load(file, **options))
    fault = lambda: loads.append("step 5")  # noqa: E731
    _, module = run("stopped", fault=fault, at_step=5, ema=0.9)
    assert module.seen[0] == 5 and [Path(name).name for name in loads[:2]] == ["last.ckpt", "step 5"]


def killed_at_save(monkeypatch, number, after):
    """Make the process end at one of its writes of a checkpoint, before or after it."""
    write, saves = AtomicCheckpointIO._write, []

    def write_until(self, checkpoint, target):
        saves.append(target.name)
        if len(saves) != number:
            return write(self, checkpoint, target)
        if after:
            write(self, checkpoint, target)
        raise Killed

    monkeypatch.setattr(AtomicCheckpointIO, "_write", write_until)
    return saves


@STOPPED_OFTEN
@pytest.mark.slow
@pytest.mark.parametrize("lost", [(), ("last.ckpt",), ("last.ckpt", "previous.ckpt")])
def test_killed_around_every_write(run, monkeypatch, tmp_path, lost):
    """The next start finds the newest file, or where that is torn the one before, or where both are the best."""
    expected, _ = run("whole")
    with monkeypatch.context() as patched:
        saves = killed_at_save(patched, 0, False)
        run("counted")
    assert saves == ["last.ckpt", "best.ckpt", "last.ckpt"] + 2 * ["last.ckpt"] * 2
    for number in range(1, len(saves) + 1):
        for after in (False, True):
            name = f"killed at {number} {after}"
            with monkeypatch.context() as patched, pytest.raises(Killed):
                killed_at_save(patched, number, after)
                run(name)
            checkpoints = tmp_path / name / "checkpoints"
            torn = [checkpoints / file for file in lost if (checkpoints / file).is_file()]
            if len(torn) < len(list(checkpoints.glob("*.ckpt"))):  # with none left, the run does not start anew unasked
                for path in torn:
                    path.write_bytes(path.read_bytes()[:1000])
            found, _ = run(name)
            assert found == expected, name


def test_the_earlier_handlers_come_back(run):
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with pytest.raises(InterruptedRunError):
        run("stopped", fault=terminate, at_step=1)
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


def test_a_second_ctrl_c_after_a_while_ends_at_once(monkeypatch):
    interruption = Interruption(None, None)
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    with interruption.listening():
        interrupt()
        interrupt()  # a launcher passing on what the terminal sent already
        now[0] += 10.0
        terminate()
        assert interruption.requested
        with pytest.raises(KeyboardInterrupt):
            interrupt()


def test_ignored_signals_stay_ignored():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    interruption = Interruption(None, None)
    try:
        with interruption.listening():
            interrupt()
        assert not interruption.requested and signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def stopped_on_two(rank, port, folder):
    """As rank `rank`: a whole run, and one that signals to rank 1 alone stop again and again."""
    become(rank, 2, port)
    with process_group("cpu", 2):
        expected, whole = train(folder / "whole", ranks=2)
        for fault in ({"at_step": 1}, {"at_step": 4}, {"at_validation": (2, 0)}):
            stopped_at = None
            try:
                train(folder / "stopped", ranks=2, fault=terminate if rank == 1 else lambda: None, **fault)
            except InterruptedRunError:
                stopped_at = fault
            assert stopped_at is not None
            torch.distributed.barrier()
        found, module = train(folder / "stopped", ranks=2)
        assert module.seen == [] and found == expected
        assert rank == 1 or "state/of one rank" in found["log"]
        pair = (own.evaluator.detections.scores for own in (module, whole))
        assert np.array_equal(*pair)
    (folder / f"done {rank}").touch()


@pytest.mark.slow
def test_a_signal_to_one_rank_stops_all(tmp_path):
    spawn_two(stopped_on_two, tmp_path)
    assert (tmp_path / "done 0").exists() and (tmp_path / "done 1").exists()


ROOT = Path(__file__).resolve().parents[2]
PHASE_2 = (
    "phase=phase2", "phase.init_from=null", "scale=debug", "phase.epochs=2", "data.world.num_train_scenes=2",
    "data.world.num_val_scenes=1", "data.world.key_frames_per_scene=4", "trainer.num_pictures=0",
)  # fmt: skip


def arguments(outputs, world, *overrides):
    return [*PHASE_2, f"paths.outputs={outputs}", f"data.root={world}", *overrides]


def ended(outputs, world, *overrides):
    """The command in this process, to its end."""
    train_command.main(arguments(outputs, world, *overrides))


def command(outputs, world, *overrides):
    return subprocess.Popen(
        [sys.executable, "-m", "src.train", *arguments(outputs, world, *overrides)],
        cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip


def end_after(process, outputs, rows, end):
    """`end` the command once its log has `rows` rows; its exit code."""
    deadline = time.monotonic() + 300
    while sum(len(path.read_text().splitlines()) for path in outputs.glob("*/metrics.csv")) <= rows:
        assert time.monotonic() < deadline and process.poll() is None, process.communicate()[1][-3000:]
        time.sleep(0.01)
    end(process.pid)
    process.communicate(timeout=180)
    return process.returncode


@pytest.mark.slow
@STOPPED_OFTEN
def test_commands_resume_as_if_nothing_had_happened(tmp_path):
    """The full model on clips: stopped inside either epoch, by Ctrl-C with loader processes, killed, and not at all."""
    world = tmp_path / "world"
    ended(tmp_path / "whole", world)
    expected = outcome(tmp_path / "whole")
    stopped = tmp_path / "stopped"
    assert end_after(command(stopped, world), stopped, 2, lambda pid: os.kill(pid, signal.SIGTERM)) == 6
    checkpoint = read_checkpoint(next(stopped.glob("horizon3d-*")) / "checkpoints" / "last.ckpt")
    assert checkpoint["global_step"] in (2, 3)
    assert checkpoint["horizon3d"]["ranks"][0]["memories"][0]["streams"] == [0, 1]
    by_key = command(stopped, world, "data.num_workers=1")
    assert end_after(by_key, stopped, 7, lambda pid: os.killpg(pid, signal.SIGINT)) == 6
    ended(stopped, world)
    assert outcome(stopped) == expected

    killed = tmp_path / "killed"
    often = "trainer.checkpoint_every_steps=2"
    assert end_after(command(killed, world, often), killed, 3, lambda pid: os.killpg(pid, signal.SIGKILL)) == -9
    checkpoint = read_checkpoint(next(killed.glob("horizon3d-*")) / "checkpoints" / "last.ckpt")
    assert checkpoint["epoch"] == 0 and checkpoint["global_step"] in (2, 4)
    ended(killed, world, often)
    assert outcome(killed) == expected
