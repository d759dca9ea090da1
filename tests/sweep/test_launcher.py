"""Processes of runs: how they are ended, and what is said about those that fail."""

import os
import signal
import sys
import time
from dataclasses import replace

import pytest

from src.sweep.launcher import Launcher, StopRequest, explain, quoted
from src.sweep.plan import RunSpec


@pytest.mark.parametrize(
    ("code", "output", "expected"),
    [
        (
            3,
            "I log\n\nConfigError: model.x=3: must be 4\n    python -m src.train\n",
            "ConfigError: model.x=3: must be 4 (exit code 3, ",
        ),
        (4, "10%\r20%\rDataError: a.json: truncated", "DataError: a.json: truncated (exit code 4, data)"),
        (
            1,
            "Traceback:\n  File x\nValueError: no\nThis is a defect of the program; please report",
            "ValueError: no (exit",
        ),
        (
            1,
            "\nOut of memory: DefaultCPUAllocator: can't allocate memory; lower data.batch_size",
            "Out of memory: Default",
        ),
        (3, "/x/y could not be written or read: No space left on device; 0 MiB are free in /x", "/x/y could not be"),
        (9, "some last words\n\n", "some last words (exit code 9)"),
        (1, "", "it printed nothing (exit code 1)"),
        (-9, "fine so far", "killed by SIGKILL (out of memory?)"),
        (-11, "", "killed by SIGSEGV"),
    ],
)
def test_reasons_in_a_line(code, output, expected):
    assert explain(code, output).startswith(expected)
    assert len(explain(1, "Error: " + "x" * 5000)) < 400


@pytest.mark.slow
def test_a_run_that_does_not_end_when_asked_is_killed_with_its_children(tmp_path, monkeypatch):
    monkeypatch.setattr("src.sweep.launcher.GRACE_PERIOD_S", 0.5)
    script = (
        "import os, signal, subprocess, sys, time\n"
        "signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
        "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'])\n"
        "print(child.pid, flush=True); time.sleep(60)"
    )
    stop, launcher = StopRequest(), Launcher([], tmp_path, 1, [])

    def watch():
        stop.requested = len(launcher.log_of("name").read_text().splitlines()[-1:][0].split()) == 1
        return False

    began = time.monotonic()
    status = launcher.run_command([sys.executable, "-c", script], "name", 0, stop, watch)
    assert status.code == -signal.SIGKILL and status.interrupted and time.monotonic() - began < 20
    child = int(launcher.log_of("name").read_text().split()[-1])
    deadline = time.monotonic() + 5
    while time.monotonic() < deadline:
        try:
            os.kill(child, 0)
        except ProcessLookupError:
            return
        if open(f"/proc/{child}/stat").read().rpartition(")")[2].split()[0] == "Z":
            return
        time.sleep(0.05)
    pytest.fail("the grandchild lives")


def test_the_log_is_continued_and_only_the_last_start_explains(tmp_path):
    launcher = Launcher([], tmp_path, 1, [])
    run = lambda code: launcher.run_command([sys.executable, "-c", code], "x", 0, StopRequest())  # noqa: E731
    assert "first" in run("raise ValueError('first')").reason
    assert run("import sys; sys.exit(2)").reason == "it printed nothing (exit code 2)"
    assert run("pass").reason == ""
    assert "first" in launcher.log_of("x").read_text() and launcher.log_of("x").read_text().count("====") == 3
    assert "could not be started" in launcher.run_command(["/no/such"], "x", 0, StopRequest()).reason


@pytest.mark.parametrize("label", ["a\\b", "end\\", 'quo"te', 'both\\"', "\\\\", "it's, a=b {c} [d]"])
def test_hydra_reads_a_label_as_it_is(label):
    from hydra.core.override_parser.overrides_parser import OverridesParser

    assert OverridesParser.create().parse_override(f"row={quoted(label)}").value() == label


def test_weights_and_biases_is_told_sweep_and_row(tmp_path):
    from src.config import compose_config

    launcher = Launcher([], tmp_path, 1, [], group="epsilon-mini")
    spec = RunSpec("r", ["model.ocsf.margin_m=0"], 0, 'a "b", 4.8 m = x', machine=["logger=wandb"])
    config, _ = compose_config([*spec.overrides, *spec.machine, *launcher.shown_as(spec)])
    assert (config.logger.wandb.group, config.logger.wandb.row) == ("epsilon-mini", spec.label)
    own = replace(spec, machine=["logger=wandb", "logger.wandb.group=mine"])
    assert [place.split("=")[0] for place in launcher.shown_as(own)] == ["logger.wandb.row"]
