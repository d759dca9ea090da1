"""Addresses of databases: what of them is never shown, and folders of any name."""

import subprocess
import sys
from pathlib import Path

import pytest

from src.errors import ConfigError
from src.reliability.passwords import hide_in_process_list, masked, without_secrets
from src.sweep.storage_address import check_address, default_storage
from src.sweep.sweep_study import SweepStudy

ROWS = {"format": 1, "kind": "rows"}


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("postgresql+psycopg://me:s3cr:et@host:5/db", "postgresql+psycopg://me:***@host:5/db"),
        ("postgresql://me:s3@cret@host/db", "postgresql://me:***@host/db"),
        ("postgresql://me:s3/c?ret@host/db", "postgresql://me:***@host/db"),
        ("postgresql://m/e:s3cret@host/db", "postgresql://m/e:***@host/db"),
        ("storage=postgresql://me@host/db?password=s3cret&x=1", "storage=postgresql://me@host/db?password=***&x=1"),
        ("storage=\"host=h password='my s3cret pw' port=1\"", 'storage="host=h password=*** port=1"'),
        ("password='my s3cret", "password=***"),
        ("PASSWORD=my s3cret pw", "PASSWORD=***"),
        ("sqlite:////a/b@c.db", "sqlite:////a/b@c.db"),
        ("logger.wandb.api_key=s3cret", "logger.wandb.api_key=***"),
        ("https://host/db?token=s3cret&x=1", "https://host/db?token=***&x=1"),
        ("model.x=1", "model.x=1"),
    ],
)
def test_passwords_are_masked(text, shown):
    assert masked(text) == shown


def test_a_driver_that_repeats_the_password_is_not_repeated():
    url = "postgresql://me:s3%40cret@host/db?password=t0p&x=1"
    said = without_secrets("no user me with s3@cret or s3%40cret or t0p", url)
    assert said == "no user me with *** or *** or ***"


def test_an_address_that_would_be_read_wrongly_is_refused_unseen():
    with pytest.raises(ConfigError, match="write @ as %40") as caught:
        check_address("postgresql://me:s3@cret@host/db")
    assert "s3" not in str(caught.value) and "cret" not in str(caught.value)
    check_address("sqlite:////a@b/c@d.db")
    check_address("postgresql://me:s3%40cret@host/db")


@pytest.mark.parametrize("name", ["{x}", "50%20off", "a?b", "a#b @:c", "{SCHEMA_VERSION}"])
def test_any_folder_can_hold_the_database(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    outputs = Path(name)
    SweepStudy(outputs, "fake-debug", default_storage(outputs), ROWS)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (outputs / "sweeps" / "sweeps.db").stat().st_size > 0


def test_the_default_address_is_as_relative_as_the_folder():
    assert default_storage(Path("outputs")) == "sqlite:///outputs/sweeps/sweeps.db"
    assert default_storage(Path("/o")) == "sqlite:////o/sweeps/sweeps.db"


@pytest.mark.parametrize("url", ["nosuch://me:s3{cret}@h/db", "nosuch://me:{s3cret@h/db", "nosuch://me:{0}s3cret@h/db"])
def test_braces_in_a_password_are_part_of_it_and_not_shown(tmp_path, url):
    with pytest.raises(ConfigError, match="cannot be used") as caught:
        SweepStudy(tmp_path, "x", url, ROWS)
    assert "cret" not in str(caught.value) and "nosuch" in str(caught.value)


@pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="the system has no /proc")
@pytest.mark.parametrize(
    "argument",
    ["storage=postgresql://me:s3%40cret@host/db", "storage=postgresql://me@host/db?password=s3cret&x=1",
     "storage=\"host=h password='my s3cret pw' port=1\"", "storage=postgresql://s3cret:s3cret@host/s3cret"],
)  # fmt: skip
def test_the_process_list_shows_no_password(argument):
    code = """
import sys
from pathlib import Path
from src.reliability.passwords import hide_in_process_list
for argument in sys.argv[1:]:
    hide_in_process_list(argument)
line = Path("/proc/self/cmdline").read_bytes()
sys.stdout.buffer.write(line + b"|" + sys.argv[1].encode())
"""
    shown = subprocess.run([sys.executable, "-c", code, argument, "seeds=2"], capture_output=True, timeout=60).stdout
    line, _, kept = shown.rpartition(b"|")
    assert kept.decode() == argument  # the command itself still knows it
    assert b"cret" not in line
    assert line.endswith(b"\0seeds=2\0") and b"storage=" in line and b"****" in line


def test_an_address_without_a_password_changes_nothing():
    before = Path("/proc/self/cmdline").read_bytes() if Path("/proc/self/cmdline").exists() else b""
    for address in ("sqlite:////a/b.db", "postgresql://me@host/db", "", "model.x=1"):
        hide_in_process_list(address)
    assert not before or Path("/proc/self/cmdline").read_bytes() == before
