"""What every entry point does around its work."""

import subprocess
import sys

import pytest

PRINTING = (
    "from src.reliability.command import run_command; "
    "run_command(lambda words: [print(n, flush=True) for n in range(10**6)])"
)


INTERRUPTED = """
import os, signal, sys
from src.reliability.command import run_command
def main(words):
    try:  # as Lightning's Trainer does
        os.kill(os.getpid(), signal.{name})
        import time; time.sleep(60)
    except KeyboardInterrupt:
        sys.exit(1)
run_command(main)
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_an_exit_that_an_interrupt_became_is_an_interruption(name):
    done = subprocess.run([sys.executable, "-c", INTERRUPTED.format(name=name)], capture_output=True, timeout=60)
    assert done.returncode == 6 and b"Interrupted; the same command" in done.stderr
    code = "import sys; from src.reliability.command import run_command; run_command(lambda words: sys.exit(7))"
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 7


def test_a_reader_that_has_had_enough_is_no_defect():
    with subprocess.Popen([sys.executable, "-c", PRINTING], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as command:
        assert command.stdout.readline() == b"0\n"
        command.stdout.close()
        assert command.stderr.read() == b"" and command.wait(timeout=60) == 141
