"""What every entry point does around its work."""

import subprocess
import sys

PRINTING = (
    "from src.reliability.command import run_command; "
    "run_command(lambda words: [print(n, flush=True) for n in range(10**6)])"
)


def test_a_reader_that_has_had_enough_is_no_defect():
    with subprocess.Popen([sys.executable, "-c", PRINTING], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as command:
        assert command.stdout.readline() == b"0\n"
        command.stdout.close()
        assert command.stderr.read() == b"" and command.wait(timeout=60) == 141
