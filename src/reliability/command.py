"""What every entry point does around its work: logging, messages instead of tracebacks, exit status."""

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
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from src.errors import ConfigError, HorizonError, InterruptedRunError

# errno of a refused write; the path and the free space are then all a user needs.
DISK_FAULTS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM}

INTERRUPT_GRACE_S = 2.0
"""Signals this soon after the first repeat it: launchers and a shared terminal send it again within milliseconds."""


def signal_name(number: int) -> str:
    """`SIGKILL` and so on, for a message; `signal N` where the system has no name for it."""
    return signal.Signals(number).name if number in set(signal.Signals) else f"signal {number}"


@contextmanager
def handling_signals(
    handler: Callable[[int, FrameType | None], None], *numbers: signal.Signals
) -> Iterator[list[signal.Signals]]:
    """Give those signals to `handler` that are not ignored, and yield them; the earlier handlers come back afterwards.

    A shell's background jobs and the processes of one launcher ignore Ctrl-C, and that is theirs to decide.
    """
    outer = {number: signal.getsignal(number) for number in numbers}
    taken = [number for number, earlier in outer.items() if earlier is not signal.SIG_IGN]
    for number in taken:
        signal.signal(number, handler)
    try:
        yield taken
    finally:
        for number, earlier in outer.items():
            signal.signal(number, earlier)


def run_command(main: Callable[[list[str]], None]) -> None:
    """Run an entry point on the command line's `key=value`s; known errors end with one message and their exit code.

    Exit codes: 0 finished, 3 configuration or checkpoint, 4 data, 5 diverged, 6 interrupted and resumable, 141 cut
    short by a closed pipe, 1 anything else.
    """
    line = "%(asctime)s %(levelname).1s %(name)s: %(message)s"
    logging.basicConfig(level=logging.INFO, format=line, datefmt="%H:%M:%S")
    for noisy in ("matplotlib", "PIL", "lightning.pytorch"):
        logging.getLogger(noisy).setLevel(logging.WARNING)
    interruptions = _handle_signals()
    try:
        main(sys.argv[1:])
    except HorizonError as error:
        print(f"\n{type(error).__name__}: {error}", file=sys.stderr)  # a progress bar may stand on the line
        sys.exit(error.exit_code)
    except (KeyboardInterrupt, SystemExit) as error:
        if isinstance(error, SystemExit) and not isinstance(error.__context__, KeyboardInterrupt):
            raise  # Lightning makes an exit of a KeyboardInterrupt; others mean their exit
        print("\nInterrupted; the same command resumes from its last checkpoint, if it writes any.", file=sys.stderr)
        sys.exit(InterruptedRunError.exit_code)
    except Exception as error:
        if isinstance(error, BrokenPipeError) and _stdout_closed():
            sys.exit(128 + signal.SIGPIPE)  # the exit status that a shell gives to a command cut short by `head`
        if interruptions:  # inside a library's compiled code, which turned it into another error
            what = f"Interrupted ({error}); the same command resumes from its last checkpoint, if it writes any."
            print(f"\n{what}", file=sys.stderr)
            sys.exit(InterruptedRunError.exit_code)
        known = _machine_fault(error)
        if known is not None:
            print(f"\n{known[0]}", file=sys.stderr)
            sys.exit(known[1])
        traceback.print_exc()
        print("This is a defect of the program; please report it with the lines above.", file=sys.stderr)
        sys.exit(1)


def _handle_signals() -> list[float]:
    """Let SIGTERM end the command as Ctrl-C does, so that temporary files are removed; returns the signals' times."""
    times: list[float] = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        times.append(time.monotonic())
        if len(times) == 1 or times[-1] - times[0] > INTERRUPT_GRACE_S:
            raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, interrupt)
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # a shell's background job, or one rank of several
        signal.signal(signal.SIGINT, interrupt)
    return times


def _stdout_closed() -> bool:
    """Whether the reader of stdout is gone; what is printed from then on is discarded."""
    poll = select.poll()
    poll.register(sys.stdout.fileno(), 0)  # POLLERR is reported whatever the mask
    if not any(event & select.POLLERR for _, event in poll.poll(0)):
        return False
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or the interpreter reports an error at exit
    return True


def _machine_fault(error: Exception) -> tuple[str, int] | None:
    """Message and exit status of a fault of the machine: a full or locked disk, too little memory."""
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
