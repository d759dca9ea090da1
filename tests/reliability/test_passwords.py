"""Passwords in addresses and overrides: masked in texts and in the process list."""

import subprocess
import sys
from pathlib import Path

import pytest

from src.reliability.passwords import hide_in_process_list, masked, without_secrets


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
