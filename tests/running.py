"""Commands as people type them: in a process of their own, or, where that is not the subject, in this one."""

import importlib
import io
import logging
import multiprocessing
import os
import runpy
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

from src.errors import HorizonError

ROOT = Path(__file__).resolve().parent.parent

FORKS = multiprocessing.get_context("forkserver")
"""Starts processes that have imported torch and the training already, which takes a new one many seconds."""
FORKS.set_forkserver_preload(["src.train", "src.evaluate", "src.sweep.__main__", "tests.faults.killing"])


def fork(function, *arguments, out, err, env=None):
    """Start a function at the root, the leader of a session of its own; what it says goes to two files."""
    process = FORKS.Process(target=_alone, args=(function, arguments, str(out), str(err), dict(env or os.environ)))
    process.start()
    return process


def _alone(function, arguments, out, err, env):
    os.setsid()
    os.chdir(ROOT)
    os.environ.clear()
    os.environ.update(env)
    for descriptor, path in ((1, out), (2, err)):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND), descriptor)
    function(*arguments)


def ended(function, *arguments, timeout=480, env=None):
    """As `fork`, to its end; with its exit code and what it said."""
    with tempfile.TemporaryDirectory() as folder:
        out, err = Path(folder) / "out", Path(folder) / "err"
        process = fork(function, *arguments, out=out, err=err, env=env)
        process.join(timeout)
        if process.is_alive():
            process.kill()
            process.join()
        said = [path.read_text() if path.exists() else "" for path in (out, err)]
    return subprocess.CompletedProcess(arguments, process.exitcode, *said)


def run_module(module, *overrides):
    """What `python -m src.<module>` does."""
    sys.argv = [f"src.{module}", *overrides]
    runpy.run_module(f"src.{module}", run_name="__main__", alter_sys=True)


def command(module, *overrides, expect=0, timeout=480, env=None):
    """Run `python -m src.<module>` at the root; its output, once it has ended with the expected exit code."""
    result = ended(run_module, module, *overrides, timeout=timeout, env=env)
    assert result.returncode == expect, result.stdout[-3000:] + result.stderr[-3000:]
    return result


def wait_for(condition, timeout=60):
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def killed_training(outputs, *overrides):
    """A training in `outputs` that gets SIGKILL, with all that it started, between its first checkpoint and its end."""
    said = outputs.with_name("said")
    process = fork(run_module, "train", *overrides, f"paths.outputs={outputs}", out=said, err=said)
    deadline = time.monotonic() + 400
    while not list(outputs.glob("*/checkpoints/last.ckpt")):
        assert time.monotonic() < deadline and process.is_alive(), said.read_text()[-2000:]
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.join()
    assert not list(outputs.glob("*/metrics.json"))


def process_of_rank(parent, rank):
    """Process id of the child that was started as `rank`."""
    for child in Path(f"/proc/{parent.pid}/task/{parent.pid}/children").read_text().split():
        if f"LOCAL_RANK={rank}".encode() in Path(f"/proc/{child}/environ").read_bytes().split(b"\0"):
            return int(child)
    raise AssertionError(f"no process of rank {rank}")


def call(module, *overrides, expect=0):
    """As `command`, in this process."""
    main = importlib.import_module(f"src.{module}").main
    root, out, err, code = logging.getLogger(), io.StringIO(), io.StringIO(), 0
    handlers, level = list(root.handlers), root.level
    root.setLevel(logging.INFO)
    root.addHandler(logging.StreamHandler(err))
    try:
        with redirect_stdout(out), redirect_stderr(err):
            main(list(overrides))
    except HorizonError as error:
        code = error.exit_code
        err.write(f"{type(error).__name__}: {error}")
    finally:
        root.setLevel(level)
        for handler in [handler for handler in root.handlers if handler not in handlers]:  # log.txt of a run
            root.removeHandler(handler)
            handler.close()
    assert code == expect, out.getvalue()[-3000:] + err.getvalue()[-3000:]
    return subprocess.CompletedProcess([module, *overrides], code, out.getvalue(), err.getvalue())
