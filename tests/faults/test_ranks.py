"""Two processes train, one of them fails in every way there is: what the user reads, how soon, and what is lost.

All faults but torchrun's strike one run in turn, which resumes after each. In the end it has to be the run that nothing
ever happened to. Its seven training frames make three steps on two ranks, and its only validation scene leaves the
second rank without a frame.
"""

import json
import logging
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from src.reliability import processes
from src.reliability.checkpoints import read_checkpoint
from src.reliability.processes import launch
from tests.faults.killing import outcome, run_folder
from tests.running import process_of_rank

pytestmark = [
    pytest.mark.faults,
    pytest.mark.skipif(sys.platform != "linux", reason="finds processes by /proc and limits memory"),
]

ROOT = Path(__file__).resolve().parents[2]
LAUNCHERS = ("RANK", "LOCAL_RANK", "NODE_RANK", "GROUP_RANK", "WORLD_SIZE", "TORCHELASTIC_RUN_ID", "SLURM_NTASKS")
EPOCHS, STEPS_OF_EPOCH = 6, 3  # each fault takes the run a step or two further
NOTICED_WITHIN_S = 60.0
DEADLINE_S = 600.0  # of one command, where many tests run side by side

FAULTY = """
import os, resource, signal, time
from datetime import timedelta
from pathlib import Path
import torch
from src import train
from src.reliability.command import run_command
from src.reliability import processes
from src.training.temporal_module import TemporalModule

def kill(module): os.kill(os.getpid(), signal.SIGKILL)
def hang(module): os.kill(os.getpid(), signal.SIGSTOP)
def terminate(module): os.kill(os.getpid(), signal.SIGTERM)
def terminate_launcher(module): os.kill(os.getppid(), signal.SIGTERM)
def spoil_weights(module):
    with torch.no_grad():
        next(module.model.parameters()).fill_(float('nan'))
def exhaust_memory(module):
    used = int(Path('/proc/self/statm').read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + 2**28, used + 2**28))
    torch.zeros(2**30)

before = TemporalModule.training_step
steps = []

def training_step(module, batch, batch_idx):
    steps.append(module.trainer.global_step)
    if len(steps) == 2 and module.trainer.global_rank == int(os.environ['FAULTY_RANK']):
        Path(os.environ['FAULT_TIME']).write_text(f'{steps[-1]} {time.time()}')
        globals()[os.environ['FAULT']](module)
    return before(module, batch, batch_idx)

TemporalModule.training_step = training_step
processes.STEP_TIMEOUT = timedelta(seconds=float(os.environ.get('STEP_TIMEOUT_S', 300)))
run_command(train.main)
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Folder of the module's data set, its runs and its faulty command."""
    folder = tmp_path_factory.mktemp("ranks")
    (folder / "faulty_train.py").write_text(FAULTY)
    return folder


def overrides(place, outputs):
    return [
        "phase=phase2", "phase.init_from=null", "scale=debug", f"phase.epochs={EPOCHS}",
        f"phase.validate_every={EPOCHS}", "data.world.num_train_scenes=1", "data.world.num_val_scenes=1",
        "data.world.key_frames_per_scene=7", "trainer=ddp", "trainer.accelerator=cpu", "trainer.num_pictures=0",
        "trainer.checkpoint_every_steps=1", f"data.root={place / 'world'}", f"paths.outputs={place / outputs}",
    ]  # fmt: skip


def environment(place):
    clean = {name: value for name, value in os.environ.items() if name not in LAUNCHERS}
    return clean | {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join([str(place), str(ROOT)])}


@pytest.fixture(scope="module")
def undisturbed(place):
    """What the run of two processes gives that nothing happens to; it writes the data set if need be."""
    command = [sys.executable, "-m", "src.train", *overrides(place, "undisturbed")]
    done = subprocess.run(
        command, cwd=ROOT, env=environment(place), capture_output=True, text=True, timeout=DEADLINE_S, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    record = json.loads((run_folder(place / "undisturbed") / "run.json").read_text())
    assert record["processes"] == 2 and record["steps"] == EPOCHS * STEPS_OF_EPOCH
    return outcome(place / "undisturbed")


class LauncherLines(logging.Handler):
    """Writes what the launcher logs to where the ranks write, in between their lines."""

    def __init__(self):
        super().__init__()
        self.records = []

    def emit(self, record):
        self.records.append(record)
        os.write(2, f"{record.getMessage()}\n".encode())


@pytest.fixture
def faulty(place, monkeypatch, capfd):
    """Go on with the shared run until a fault strikes a rank; (exit code, what the user reads, seconds to notice)."""
    for name in LAUNCHERS:
        monkeypatch.delenv(name, raising=False)
    for name, value in environment(place).items():
        monkeypatch.setenv(name, value)
    monkeypatch.chdir(ROOT)
    logger = logging.getLogger("src.reliability.processes")
    handler = LauncherLines()

    def run(fault, rank, module="faulty_train", **settings):
        struck = place / "struck"
        struck.unlink(missing_ok=True)
        for name, value in {"FAULT": fault, "FAULTY_RANK": rank, "FAULT_TIME": struck, **settings}.items():
            monkeypatch.setenv(name, str(value))
        logger.addHandler(handler)
        try:
            launch(module, overrides(place, "struck again and again"), 2)
            code = 0
        except SystemExit as end:
            code = end.code
        finally:
            logger.removeHandler(handler)
        ended = time.time()
        text = capfd.readouterr().err
        noticed = None
        if struck.exists():
            step, at = struck.read_text().split()
            noticed = handler.records[0].created - float(at) if handler.records else None
            assert fault == "hang" or ended - float(at) < NOTICED_WITHIN_S, text
            told = "" if noticed is None else f"reported after {noticed:.2f} s, "
            with capfd.disabled():
                print(f"\n{fault} of rank {rank} at step {step}: {told}all ended after {ended - float(at):.2f} s")
        return code, text

    return run


def in_this_order(text, *parts):
    places = [text.find(part) for part in parts]
    assert -1 not in places and places == sorted(places), (dict(zip(parts, places, strict=True)), text)


@pytest.mark.parametrize("rank", [0, 1])
def test_a_killed_rank_ends_the_job_and_is_named_first(faulty, rank):
    code, text = faulty("kill", rank)
    assert code == 1, text
    in_this_order(text, f"process {rank} of 2 was killed by SIGKILL", "another process of this run ended")
    assert "Traceback" not in text


def test_a_rank_without_memory_says_so_before_the_other_misses_it(faulty):
    code, text = faulty("exhaust_memory", 1)
    assert code == 1, text
    in_this_order(text, "Out of memory: ", "process 1 of 2 ended with exit code 1", "another process of this run ended")
    assert "Traceback" not in text


@pytest.mark.parametrize("rank", [0, 1])
def test_a_rank_whose_loss_is_not_finite_is_named(faulty, rank):
    code, text = faulty("spoil_weights", rank)
    assert code == 5, text
    in_this_order(text, "DivergedError: step ", f"of rank {rank} are not finite")
    assert "another process of this run" not in text and "Traceback" not in text


def test_a_broken_file_on_one_rank_is_what_the_user_reads(faulty, place, undisturbed):
    file = min((place / "world" / "samples").glob("RADAR*/*.pcd"))  # of the training scene, which is written first
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    try:
        code, text = faulty("", -1)
    finally:
        file.write_bytes(whole)
    assert code == 4, text
    in_this_order(text, "DataError: ", file.name, " of 2 ended with exit code 4", "another process of this run ended")
    assert "Traceback" not in text and text.count("DataError") == 1


@pytest.mark.parametrize("rank", [0, 1])
def test_a_rank_that_hangs_ends_the_job_after_the_time_for_a_step(faulty, rank, monkeypatch):
    """Twenty seconds instead of five minutes; the rest is as it is."""
    monkeypatch.setattr(processes, "TERMINATION_GRACE_S", 5.0)
    code, text = faulty("hang", rank, STEP_TIMEOUT_S=20)
    assert code == 1, text
    in_this_order(
        text, "another process of this run hangs or is cut off", f"process {1 - rank} of 2 ended with exit code 1",
        f"process {rank} of 2 did not end within 5 s; killing it",
    )  # fmt: skip
    assert "Timed out waiting 20000ms" in text


@pytest.mark.parametrize(("fault", "rank"), [("terminate", 0), ("terminate", 1), ("terminate_launcher", 0)])
def test_a_signal_to_a_rank_or_to_the_launcher_ends_all_with_a_checkpoint(faulty, place, fault, rank):
    code, text = faulty(fault, rank)
    assert code == 6, text
    assert "another process of this run" not in text and "Traceback" not in text
    step = int((place / "struck").read_text().split()[0])
    folder = run_folder(place / "struck again and again")
    assert read_checkpoint(folder / "checkpoints" / "last.ckpt")["global_step"] == step + 1
    assert f"training was stopped after {step + 1} steps" in text


def test_after_all_of_this_the_run_is_the_one_that_nothing_happened_to(faulty, place, undisturbed):
    code, text = faulty("", -1, module="src.train")
    assert code == 0, text
    outputs = place / "struck again and again"
    dumps = [path.name for path in run_folder(outputs).glob("nonfinite-*.pt")]  # of the weights that were spoiled
    assert outcome(outputs) == undisturbed | {"files": sorted([*undisturbed["files"], *dumps])}


def torchrun(place, outputs, *options):
    arguments = ["--standalone", "--nproc-per-node", "2", *options, "-m", "src.train", *overrides(place, outputs)]
    return subprocess.Popen(
        [sys.executable, "-m", "torch.distributed.run", *arguments, "trainer.devices=2"],
        cwd=ROOT, env=environment(place), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


def after_rows(running, place, outputs, rows):
    """Wait until the run's log has so many rows."""
    deadline = time.monotonic() + DEADLINE_S
    log = place / outputs
    while sum(len(path.read_text().splitlines()) for path in log.glob("horizon3d-*/metrics.csv")) <= rows:
        assert time.monotonic() < deadline and running.poll() is None, running.communicate()[0][-3000:]
        time.sleep(0.02)


def test_torchrun_starts_again_after_a_killed_rank_and_nothing_is_lost(place, undisturbed):
    """First SIGTERM to torchrun itself, then kill -9 of a rank under the next one, which restarts it."""
    running = torchrun(place, "torchrun")
    try:
        after_rows(running, place, "torchrun", 1)
        running.terminate()
        output, _ = running.communicate(timeout=DEADLINE_S)
        assert running.returncode != 0 and output.count("training was stopped after") >= 1, output[-3000:]
        steps = read_checkpoint(run_folder(place / "torchrun") / "checkpoints" / "last.ckpt")["global_step"]
        assert f"training was stopped after {steps} steps" in output

        running = torchrun(place, "torchrun", "--max-restarts", "1")
        after_rows(running, place, "torchrun", steps + 2)
        os.kill(process_of_rank(running, 1), signal.SIGKILL)
        output, _ = running.communicate(timeout=DEADLINE_S)
        assert running.returncode == 0, output[-3000:]
        assert output.count("resuming from") == 2 and "failed (exitcode: -9) local_rank: 1" in output, output[-3000:]
        assert outcome(place / "torchrun") == undisturbed
    finally:
        running.kill()
