"""What every entry point does around its work: logging, messages instead of tracebacks, exit codes."""

from __future__ import annotations

import errno
import logging
import os
import select
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from types import FrameType

from src.errors import ConfigError, HorizonError, InterruptedRunError

# What the system says when it refuses to write; the path and the free space are then all a user needs.
DISK_FAULTS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM}

REPEATED_WITHIN_S = 2.0
"""Launchers, and a process that shares its parent's terminal, get the same signal several times within milliseconds."""


def run_command(main: Callable[[list[str]], None]) -> None:
    """Run an entry point on the command line's `key=value`s; known errors end with one message and their exit code.

    Exit codes: 0 finished, 3 configuration or checkpoint, 4 data, 5 diverged, 6 interrupted and resumable, 1 a defect.
    """
    line = "%(asctime)s %(levelname).1s %(name)s: %(message)s"
    logging.basicConfig(level=logging.INFO, format=line, datefmt="%H:%M:%S")
    for noisy in ("matplotlib", "PIL", "lightning.pytorch.utilities.rank_zero"):
        logging.getLogger(noisy).setLevel(logging.WARNING)
    interruptions = _listen()
    try:
        main(sys.argv[1:])
    except HorizonError as error:
        print(f"\n{type(error).__name__}: {error}", file=sys.stderr)  # a progress bar may stand on the line
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        print("\nInterrupted; the same command goes on from a checkpoint where it writes any.", file=sys.stderr)
        sys.exit(InterruptedRunError.exit_code)
    except Exception as error:
        if isinstance(error, BrokenPipeError) and _reader_has_gone():
            sys.exit(128 + signal.SIGPIPE)  # what a shell says of a command whose output `head` has had enough of
        if interruptions:  # it struck inside a library's compiled code, which made another error of it
            what = f"Interrupted ({error}); the same command goes on from a checkpoint where it writes any."
            print(f"\n{what}", file=sys.stderr)
            sys.exit(InterruptedRunError.exit_code)
        known = _machine_fault(error)
        if known is not None:
            print(f"\n{known[0]}", file=sys.stderr)
            sys.exit(known[1])
        traceback.print_exc()
        print("This is a defect of the program; please report it with the lines above.", file=sys.stderr)
        sys.exit(1)


def _listen() -> list[int]:
    """Let SIGTERM end the command as Ctrl-C does, so that temporary files are removed; returns when signals came."""
    came: list[float] = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        came.append(time.monotonic())
        if len(came) == 1 or came[-1] - came[0] > REPEATED_WITHIN_S:
            raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, interrupt)
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # a shell's background job, or one rank of several
        signal.signal(signal.SIGINT, interrupt)
    return came


def _reader_has_gone() -> bool:
    """Whether nobody reads what is printed any more; then nothing more is."""
    poll = select.poll()
    poll.register(sys.stdout.fileno(), 0)  # whatever is asked for, a broken pipe is told
    if not any(event & select.POLLERR for _, event in poll.poll(0)):
        return False
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or the interpreter complains at its end
    return True


def _machine_fault(error: Exception) -> tuple[str, int] | None:
    """Message and exit code where the machine is at fault: a full or locked disk, too little memory."""
    if isinstance(error, OSError) and error.errno in DISK_FAULTS:
        place = Path(str(error.filename or "")).absolute().parent
        place = place if place.is_dir() else Path.cwd()
        free = shutil.disk_usage(place).free // 2**20
        what = f"{error.filename or 'A file'} could not be written or read: {error.strerror}"
        return f"{what}; {free} MiB are free in {place}; make room or choose another folder", ConfigError.exit_code
    words = str(error)  # of torch on a CPU and on a GPU; of numpy and Python in an error of its own
    if isinstance(error, MemoryError) or "allocate memory" in words or "out of memory" in words:
        remedy = "lower data.batch_size or data.num_workers, or choose a smaller scale or backbone"
        return f"Out of memory: {error}; {remedy}", 1
    return None
