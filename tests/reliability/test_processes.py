"""Who starts several processes, who is the main one, how they end; the commands of training on several."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import torch

from src import evaluate
from src.errors import ConfigError
from src.reliability import processes
from src.reliability.processes import (
    build_strategy,
    check_devices,
    created_externally,
    decided_by_main,
    is_main_process,
    launch,
    process_group,
)
from tests.running import process_of_rank

ROOT = Path(__file__).resolve().parents[2]
LAUNCHERS = ("RANK", "LOCAL_RANK", "NODE_RANK", "GROUP_RANK", "WORLD_SIZE", "TORCHELASTIC_RUN_ID", "SLURM_NTASKS")


@pytest.fixture(autouse=True)
def nobody_started_this(monkeypatch):
    for name in LAUNCHERS:
        monkeypatch.delenv(name, raising=False)


def slurm(task, tasks, nodes):
    """What srun sets for one of `tasks` processes, the same number on each node."""
    per_node = tasks // nodes
    values = {
        "SLURM_JOB_ID": "4242", "SLURM_JOB_NAME": "train", "SLURM_NODELIST": "127.0.0.1", "SLURM_NNODES": nodes,
        "SLURM_NTASKS": tasks, "SLURM_NTASKS_PER_NODE": per_node, "SLURM_PROCID": task,
        "SLURM_LOCALID": task % per_node, "SLURM_NODEID": task // per_node,
    }  # fmt: skip
    return {name: str(value) for name, value in values.items()}


def torchrun(rank, world_size):
    values = {"TORCHELASTIC_RUN_ID": "none", "RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": world_size}
    return {name: str(value) for name, value in values.items()}


def pretend(monkeypatch, environment):
    for name, value in environment.items():
        monkeypatch.setenv(name, value)


# ---------------------------------------------------------------- who and how many


def test_devices_must_be_there(monkeypatch):
    check_devices("auto", 1)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    check_devices("gpu", 2)
    check_devices("cpu", 3)
    for accelerator in ("gpu", "auto"):
        with pytest.raises(ConfigError, match="trainer.devices=3, but torch sees 2 GPUs"):
            check_devices(accelerator, 3)


def test_more_processes_than_cores_are_only_warned_of(caplog):
    cores = os.cpu_count()
    check_devices("cpu", cores)
    assert not caplog.records
    check_devices("cpu", cores + 1)
    assert f"on {cores} cores" in caplog.text


def test_a_single_process_is_the_main_one_and_decides():
    assert is_main_process() and not created_externally()
    assert build_strategy("cpu", 1) == "auto"
    with process_group("cpu", 1):
        assert not torch.distributed.is_initialized()
        assert decided_by_main(lambda: "this") == "this"


@pytest.mark.parametrize(
    "start", [torchrun, lambda rank, size: slurm(rank, size, 2), lambda rank, size: slurm(rank, size, 1)]
)
def test_ranks_started_from_outside_are_recognised(start, monkeypatch):
    for rank in range(4):
        pretend(monkeypatch, start(rank, 4))
        assert created_externally()
        assert is_main_process() == (rank == 0)
    check_devices("cpu", 2, num_nodes=2)
    with pytest.raises(ConfigError, match=r"4 process\(es\) were started, but trainer.devices=1"):
        check_devices("cpu", 1)


def test_several_nodes_need_somebody_who_starts_them():
    with pytest.raises(ConfigError, match="trainer.num_nodes=2: start the command with srun or torchrun"):
        check_devices("cpu", 1, num_nodes=2)


def test_slurm_without_tasks_per_node_is_a_clear_error(monkeypatch):
    environment = slurm(0, 2, 1)
    environment.pop("SLURM_NTASKS_PER_NODE")
    pretend(monkeypatch, environment)
    with pytest.raises(ConfigError, match="ntasks-per-node"):
        check_devices("cpu", 2)


# ---------------------------------------------------------------- starting and ending


@pytest.fixture
def command(tmp_path, monkeypatch):
    """Write a module whose code knows its `rank`; launch it in two processes and return the exit code."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), str(ROOT)]))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(processes, "TERMINATION_GRACE_S", 1.0)

    def run(code):
        (tmp_path / "some_command.py").write_text(
            f"import os, signal, sys, time\nrank = int(os.environ['RANK'])\n{code}"
        )
        try:
            launch("some_command", ["key=value", "other=1"], devices=2)
        except SystemExit as end:
            return end.code
        return 0

    return run


def test_the_same_command_runs_once_per_device(command, tmp_path):
    assert (
        command("open(f'{rank}', 'w').write(repr([sys.argv[1:], os.environ['WORLD_SIZE'], os.environ['MASTER_PORT']]))")
        == 0
    )
    first, second = ((tmp_path / name).read_text() for name in "01")
    assert first == second and first.startswith("[['key=value', 'other=1'], '2', '")


@pytest.mark.parametrize(
    ("code", "expected", "warning"),
    [
        ("sys.exit(0)", 0, []),
        # The one that lost the other says 1, the cause counts; whose message stands there is a matter of time.
        ("sys.exit(4 if rank else 1)", 4, None),
        ("sys.exit(5 if rank else 0)", 5, ["process 1 of 2 ended with exit code 5; ending the others"]),
        ("sys.exit(6)", 6, []),  # stopped from outside is no failure
        (
            "os.kill(os.getpid(), signal.SIGKILL) if rank else time.sleep(60)",
            1,
            [
                "process 1 of 2 was killed by SIGKILL, as the system does when memory is short; ending the others",
                "process 0 of 2 did not end within 1 s; killing it",
            ],
        ),
        (
            "time.sleep(60) if rank else os.kill(os.getpid(), signal.SIGSEGV)",
            1,
            [
                "process 0 of 2 was killed by SIGSEGV; ending the others",
                "process 1 of 2 did not end within 1 s; killing it",
            ],
        ),
    ],
)
def test_the_launcher_says_which_process_failed_and_ends_with_the_code_of_the_cause(
    code, expected, warning, command, caplog
):
    started = time.monotonic()
    assert command(code) == expected
    assert time.monotonic() - started < 20, "nobody is left waiting"
    if warning is not None:
        assert [record.message for record in caplog.records if record.levelname == "WARNING"] == warning


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_to_the_launching_process_reaches_all_as_sigterm(number, command, tmp_path):
    def once_both_wait():
        while len(list(tmp_path.glob("ready*"))) < 2:
            time.sleep(0.02)
        os.kill(os.getpid(), number)

    threading.Thread(target=once_both_wait, daemon=True).start()
    before = signal.getsignal(number)
    end = "signal.signal(signal.SIGTERM, lambda *_: sys.exit(6))\nopen(f'ready{rank}', 'w')\ntime.sleep(60)"
    assert command(end) == 6
    assert signal.getsignal(number) is before


DECIDE = """
from src.reliability.command import run_command
from src.errors import ConfigError
from src.reliability.processes import decided_by_main, process_group

def decide():
    open('decided', 'a').write(str(rank))
    return {'resume_from': None, 'step': 7}

def refuse():
    raise ConfigError('such a folder is taken')

def main(overrides):
    with process_group('cpu', 2):
        value = decided_by_main(decide)
        open(f'answer{rank}', 'w').write(repr(value))
        decided_by_main(refuse)
        open('continued', 'w')

run_command(main)
"""


@pytest.mark.slow
def test_the_main_process_decides_for_all_and_what_it_refuses_ends_all(command, tmp_path, capfd):
    assert command(DECIDE) == 3
    assert (tmp_path / "decided").read_text() == "0"
    assert {(tmp_path / f"answer{rank}").read_text() for rank in (0, 1)} == {"{'resume_from': None, 'step': 7}"}
    assert not (tmp_path / "continued").exists()
    assert capfd.readouterr().err.count("ConfigError: such a folder is taken") == 1


MEET = """
import torch
from src.reliability.command import run_command
from src.errors import DataError
from src.reliability import processes

def main(overrides):
    processes.REPORT_DELAY_S = 3.0
    with processes.process_group('cpu', 2):
        for turn in range(1000):
            torch.distributed.all_reduce(torch.ones(1))
            if turn == 3 and rank == 1:
                {fault}

run_command(main)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "code", "cause"),
    [
        ("raise DataError('such a file')", 4, "DataError: such a file"),
        ("os.kill(os.getpid(), signal.SIGKILL)", 1, "process 1 of 2 was killed by SIGKILL"),
    ],
)
def test_what_ended_a_process_is_read_before_what_the_others_say(fault, code, cause, command, monkeypatch, capfd):
    """`tests/faults/test_ranks.py` does it to real training."""
    monkeypatch.setattr(processes, "TERMINATION_GRACE_S", 30.0)
    # The launcher's lines come in between those of the processes.
    monkeypatch.setattr(processes.logger, "warning", lambda text, *values: os.write(2, (text % values).encode()))
    assert command(MEET.format(fault=fault)) == code
    text = capfd.readouterr().err
    assert -1 < text.find(cause) < text.find("another process of this run ended, its message says why"), text
    assert "Traceback" not in text, text


MEET_AGAIN = """
import torch
from src.reliability import processes

os.environ |= {
    'TORCHELASTIC_RUN_ID': 'none', 'TORCHELASTIC_USE_AGENT_STORE': 'True', 'MASTER_PORT': os.environ['AGENT_PORT'],
}
for attempt in range(5):  # which of two connects to the other is a matter of their ports
    os.environ['TORCHELASTIC_RESTART_COUNT'] = str(attempt)
    time.sleep(0.5 * rank)  # the other must not find the address of the attempt before meanwhile
    with processes.process_group('cpu', 2):
        torch.distributed.all_reduce(torch.ones(1))
        processes.decided_by_main(lambda: None)
open(f'met again {rank}', 'w')
"""


@pytest.mark.slow
def test_processes_that_torchrun_starts_again_find_each_other(command, tmp_path, monkeypatch):
    """The agent's store outlives its processes."""
    agent = torch.distributed.TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False)
    monkeypatch.setenv("AGENT_PORT", str(agent.port))
    assert command(MEET_AGAIN) == 0
    assert len(list(tmp_path.glob("met again *"))) == 2


# ---------------------------------------------------------------- the commands as people type them

EPOCHS = 8


def environment():
    clean = {name: value for name, value in os.environ.items() if name not in LAUNCHERS}
    return clean | {"OMP_NUM_THREADS": "1"}


def start(*command, env=None):
    return subprocess.Popen(
        [sys.executable, "-m", *command], cwd=ROOT, env=environment() | (env or {}),
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


def finish(*running, expect=None, timeout=360):
    """Outputs of commands that must end in time; none of them survives a failure."""
    try:
        outputs = [process.communicate(timeout=timeout)[0] for process in running]
    finally:
        for process in running:
            process.kill()
    for process, output in zip(running, outputs, strict=True):
        assert expect is None or process.returncode == expect, output[-3000:]
    return outputs


def wait_for(path, *running, timeout=300):
    deadline = time.monotonic() + timeout
    while not path():
        assert time.monotonic() < deadline and all(process.poll() is None for process in running), [
            process.poll() for process in running
        ]
        time.sleep(0.05)


def last_checkpoint(outputs, phase):
    return lambda: next(iter(outputs.glob(f"horizon3d-{phase}-debug-*/checkpoints/last.ckpt")), None)


def overrides(outputs, phase):
    return [
        f"phase={phase}", "scale=debug", "trainer=ddp", "trainer.accelerator=cpu", f"phase.epochs={EPOCHS}",
        f"phase.validate_every={EPOCHS}", f"paths.outputs={outputs}",
    ]  # fmt: skip


needs_proc = pytest.mark.skipif(sys.platform != "linux", reason="finds processes by /proc")


@pytest.fixture(scope="module")
def outputs(tmp_path_factory):
    return tmp_path_factory.mktemp("outputs")


@pytest.fixture(scope="module")
def phase1(outputs):
    """A run that was stopped by SIGTERM to its second process and ended under torchrun: its folder."""
    command = ["src.train", *overrides(outputs, "phase1"), "trainer.devices=2"]
    running = start(*command)
    wait_for(last_checkpoint(outputs, "phase1"), running)
    os.kill(process_of_rank(running, 1), signal.SIGTERM)
    (output,) = finish(running, expect=6)
    assert "the same command resumes" in output
    (output,) = finish(start("torch.distributed.run", "--standalone", "--nproc-per-node=2", "-m", *command), expect=0)
    assert "resuming from" in output
    return last_checkpoint(outputs, "phase1")().parents[1]


@needs_proc
@pytest.mark.slow
def test_a_stopped_run_resumes_under_torchrun_and_scores_as_one_process_does(phase1, outputs, tmp_path):
    record = json.loads((phase1 / "run.json").read_text())
    assert record["resumed"] and record["processes"] == 2 and record["steps"] == EPOCHS
    checkpoint = phase1 / "checkpoints" / "last.ckpt"
    evaluate.main(
        [f"checkpoint={checkpoint}", f"out={tmp_path}", f"paths.outputs={outputs}", "trainer.accelerator=cpu"]
    )
    alone, together = (json.loads((folder / "metrics.json").read_text()) for folder in (tmp_path, phase1))
    for name in ("mAP", "NDS", "mATE", "mASE", "mAOE", "mAVE", "mAAE"):
        assert together[name] == pytest.approx(alone[name], abs=1e-6), name
    assert together["mATE"] != 1, "nothing is matched, so nothing is compared"


@needs_proc
@pytest.mark.faults
def test_a_run_on_two_nodes_survives_the_loss_of_one(phase1, outputs):
    """Temporal training as SLURM starts it; killed without warning on one node, ended by the plain command."""
    command = ["src.train", *overrides(outputs, "phase2"), f"phase.init_from={phase1 / 'checkpoints' / 'last.ckpt'}"]
    nodes = [
        start(*command, "trainer.devices=1", "trainer.num_nodes=2", env=slurm(task, tasks=2, nodes=2))
        for task in (0, 1)
    ]
    wait_for(last_checkpoint(outputs, "phase2"), *nodes)
    nodes[1].kill()
    left, _ = finish(*nodes, timeout=180)
    assert nodes[0].returncode == 1 and "another process of this run ended" in left, left[-3000:]
    finish(start(*command, "trainer.devices=2"), expect=0)
    record = json.loads((last_checkpoint(outputs, "phase2")().parents[1] / "run.json").read_text())
    assert record["resumed"] and record["steps"] == EPOCHS
