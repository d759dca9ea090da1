"""Commands as people type them: in a process of their own, or, where that is not the subject, in this one."""

import importlib
import io
import logging
import multiprocessing
import os
import runpy
import subprocess
import sys
import tempfile
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

from src.errors import HorizonError

ROOT = Path(__file__).resolve().parent.parent

FORKS = multiprocessing.get_context("forkserver")
"""Starts processes that have imported torch and the training already, which takes a new one many seconds."""
FORKS.set_forkserver_preload(["src.train", "src.evaluate", "src.sweep.__main__", "tests.faults.killing"])


def start(module, *overrides, out, err, env=None):
    """Start `python -m src.<module>` at the root, the leader of a session of its own; output goes to two files."""
    surroundings = dict(os.environ) | (env or {})
    process = FORKS.Process(target=_run, args=(module, overrides, str(out), str(err), surroundings))
    process.start()
    return process


def _run(module, overrides, out, err, surroundings):
    os.setsid()
    os.chdir(ROOT)
    os.environ.clear()
    os.environ.update(surroundings)
    for descriptor, path in ((1, out), (2, err)):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND), descriptor)
    sys.argv = [f"src.{module}", *overrides]
    runpy.run_module(f"src.{module}", run_name="__main__", alter_sys=True)


def command(module, *overrides, expect=0, timeout=480, env=None):
    """Run `python -m src.<module>` at the root; its output, once it has ended with the expected exit code."""
    with tempfile.TemporaryDirectory() as folder:
        out, err = Path(folder) / "out", Path(folder) / "err"
        process = start(module, *overrides, out=out, err=err, env=env)
        process.join(timeout)
        if process.is_alive():
            process.kill()
            process.join()
        said = [path.read_text() if path.exists() else "" for path in (out, err)]
    result = subprocess.CompletedProcess([module, *overrides], process.exitcode, *said)
    assert result.returncode == expect, result.stdout[-3000:] + result.stderr[-3000:]
    return result


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
