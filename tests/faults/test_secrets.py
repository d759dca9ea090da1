"""Secrets of the surroundings and of the command line, looked for in all that real commands write and say."""

import os
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import pytest

from tests.running import ROOT, command

KEY = "5ecretke" * 5  # as long as W&B's are
PASSWORD, OPTION = "pa55-w0rd-of-the-database", "an0ther-pa55-of-its-option"
ADDRESS = f"storage=postgresql+psycopg://me:{PASSWORD}@127.0.0.1:9/sweeps?password={OPTION}"
RADAR_ALONE = ["model.kggi=null", "model.ocsf=null", "scale=debug", "trainer=cpu", "data.num_workers=0"]


def surroundings(place):
    """Full of secrets."""
    known = {name: value for name, value in os.environ.items() if not name.startswith("WANDB_")}
    secrets = {"WANDB_API_KEY": KEY, "PGPASSWORD": f"{PASSWORD}-of-libpq", "HORIZON3D_SECRET": KEY[::-1]}
    return known | secrets | {"HOME": str(place / "home"), "OMP_NUM_THREADS": "1"}


def folders(place):
    return f"paths.outputs={place / 'outputs'}", f"paths.reports={place / 'reports'}"


def run(place, module, *words, expect):
    """What a command says."""
    result = command(module, *words, *folders(place), expect=expect, env=surroundings(place))
    return (result.stdout + result.stderr).encode()


def run_watched(place, module, *words, expect):
    """What a command says, started by a shell's own line, and every command line seen meanwhile."""
    line = [sys.executable, "-m", f"src.{module}", *words, *folders(place)]
    with (place / "said").open("w+b") as said:
        process = subprocess.Popen(line, cwd=ROOT, stdout=said, stderr=subprocess.STDOUT, env=surroundings(place))
        lines = set()
        while process.poll() is None:
            lines |= command_lines(process.pid)
            time.sleep(0.05)
        said.seek(0)
        text = said.read()
    (place / "said").unlink()
    assert process.returncode == expect, text.decode(errors="replace")[-3000:]
    return text, lines


def command_lines(pid):
    """Of a process and those it started; empty where the system has no /proc."""
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        return {Path(f"/proc/{pid}/cmdline").read_bytes()}.union(*map(command_lines, children))
    except OSError:
        return set()


def assert_no_secret(name, content):
    for secret in (KEY, KEY[::-1], PASSWORD, OPTION):
        assert secret.encode() not in content, f"{secret} stands in {name}"


def assert_nothing_written(place):
    """Every file under `place`, and what is inside archives, which may be compressed."""
    files = [path for path in place.rglob("*") if path.is_file()]
    for path in files:
        assert_no_secret(path, path.read_bytes())
        assert_no_secret("its name", str(path).encode())
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                for entry in archive.namelist():
                    assert_no_secret(f"{path}, {entry}", archive.read(entry))
    return files


@pytest.mark.slow
def test_nothing_that_commands_write_or_say_holds_a_secret(tmp_path):
    """A training with W&B, its results, pages and the exported dashboard."""
    pytest.importorskip("wandb")
    wandb = ["logger=wandb", "logger.wandb.offline=true"]
    text, lines = run_watched(tmp_path, "train", "phase=phase1", *RADAR_ALONE, *wandb, expect=0)
    text += run(tmp_path, "report", "scale=debug", expect=0)
    text += run(tmp_path, "dashboard", f"export={tmp_path / 'dashboard.html'}", expect=0)
    assert_no_secret("what was said", text)
    assert_no_secret("a command line", b"\n".join(lines))
    names = {path.name for path in assert_nothing_written(tmp_path)}
    assert {"config.yaml", "run.json", "last.ckpt", "log.txt", "dashboard.html", "phase1_debug.md"} <= names
    assert any(name.endswith(".wandb") for name in names)


@pytest.mark.slow
def test_the_password_of_a_database_is_neither_shown_nor_written(tmp_path):
    """A plan, a server that cannot be reached, and a command that takes no address."""
    pytest.importorskip("psycopg")
    plan = ["+sweep=epsilon", "dry_run=true", ADDRESS]
    text, seen = run_watched(tmp_path, "sweep", *plan, *RADAR_ALONE, expect=0)
    assert "5 results" in text.decode()
    assert_no_secret("the plan", text)
    lines = {line for line in seen if b"src.sweep" in line}
    for module, words, said in (
        ("sweep", ["+sweep=epsilon", ADDRESS], "cannot be used"),
        ("train", ["phase=phase1", ADDRESS], "looks like a password"),
    ):
        text = run(tmp_path, module, *words, *RADAR_ALONE, expect=3)
        assert said in text.decode()
        assert_no_secret(module, text)
    assert_nothing_written(tmp_path)
    # The command line says it until Python has loaded what it needs to hide it; then stars.
    assert not lines or any(b"storage=" in line and PASSWORD.encode() not in line for line in lines)
