"""Reads damaged files in a child process with little memory and little time, and says which case broke the reader."""

from __future__ import annotations

import faulthandler
import json
import logging
import mmap
import os
import random
import resource
import signal
import traceback
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from src.errors import HorizonError
from tests.faults.mutations import Mutate

MEMORY_BYTES = 600 * 2**20
"""What reading one small damaged file may take beside what the process has."""
CPU_S, WALL_S = 10.0, 60.0
"""A case that computes or waits for longer hangs."""
MOST_FAULTS = 5


@dataclass(frozen=True, kw_only=True)
class Kind:
    """One kind of file: whole examples, how they are damaged, and how they are read.

    `read` raises AssertionError for a value that cannot be.
    """

    name: str
    examples: list[bytes]
    mutate: Mutate
    read: Callable[[Path], Any]
    place: str  # path below the folder
    errors: tuple[type[BaseException], ...] = (HorizonError,)
    prepare: Callable[[Path], None] = lambda folder: None  # once, in the child


@dataclass
class Outcome:
    """What became of the cases of a kind."""

    cases: int = 0
    refused: int = 0
    accepted: int = 0
    faults: list[str] = field(default_factory=list)  # each with what repeats it


def damaged_file(kind: Kind, seed: int, case: int, strangers: list[bytes]) -> tuple[str, bytes]:
    """What was done to an example, and the bytes of one case; the same for the same numbers."""
    rng = random.Random(f"{seed}/{kind.name}/{case}")
    return kind.mutate(rng, kind.examples[rng.randrange(len(kind.examples))], strangers)


def run_cases(kind: Kind, seed: int, cases: range, folder: Path, strangers: list[bytes]) -> Outcome:
    """Read each case's file in a child. A child that dies or hangs is a fault of its case; the next is read."""
    outcome = Outcome()
    shared = mmap.mmap(-1, 24)  # case, refused, accepted: outlives a child that dies
    at = cases.start
    while at < cases.stop and len(outcome.faults) < MOST_FAULTS:
        report, pipe = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(report)
            try:
                _read_all(kind, seed, range(at, cases.stop), folder, strangers, shared, pipe)
            except BaseException:  # of the fuzzing itself
                reached = int.from_bytes(shared[:8], "little")
                _report(pipe, kind, seed, reached, "no file was made", traceback.format_exc()[-800:])
            finally:
                os._exit(0)
        os.close(pipe)
        with os.fdopen(report) as lines:
            said = [json.loads(line) for line in lines if line.endswith("\n")]
        _, status = os.waitpid(child, 0)
        reached, refused, accepted = (int.from_bytes(shared[i : i + 8], "little") for i in (0, 8, 16))
        outcome.faults += said
        outcome.refused, outcome.accepted = outcome.refused + refused, outcome.accepted + accepted
        if os.WIFSIGNALED(status):
            what = {signal.SIGPROF: f"computes for more than {CPU_S:g} s", signal.SIGALRM: f"waits for {WALL_S:g} s"}
            number = os.WTERMSIG(status)
            fault = what.get(number, f"kills the process: {signal.Signals(number).name}")
            outcome.faults.append(_named(kind, seed, reached, strangers, fault))
        at = reached + 1
    outcome.cases = at - cases.start
    return outcome


def _read_all(
    kind: Kind, seed: int, cases: range, folder: Path, strangers: list[bytes], shared: mmap.mmap, pipe: int
) -> None:
    """In the child: every case, with the case at hand in shared memory and faults as lines of a pipe."""
    logging.disable(logging.CRITICAL)
    faulthandler.disable()  # pytest's; a death is reported with its case instead
    warnings.simplefilter("error", RuntimeWarning)  # numpy's overflows: a number that cannot be, on its way
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, resource.getrlimit(resource.RLIMIT_AS)[1]))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    kind.prepare(folder)
    refused = accepted = faults = 0
    shared[8:24] = bytes(16)
    for case in cases:
        shared[0:8] = case.to_bytes(8, "little")
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, WALL_S)
        said, content = damaged_file(kind, seed, case, strangers)
        path = folder / kind.place
        path.parent.mkdir(parents=True, exist_ok=True)
        whole = path.read_bytes() if path.is_file() else None
        path.write_bytes(content)
        signal.setitimer(signal.ITIMER_PROF, CPU_S)
        try:
            kind.read(path)
            accepted += 1
        except kind.errors as error:
            refused += 1
            if path.name not in str(error) and path.parent.name not in str(error):
                faults += _report(pipe, kind, seed, case, said, f"the error does not name the file: {error!s:.300}")
        except BaseException as error:
            where = traceback.extract_tb(error.__traceback__)[-1]
            what = f"{type(error).__name__} from {Path(where.filename).name}:{where.lineno}: {error!s:.300}"
            faults += _report(pipe, kind, seed, case, said, what)
        signal.setitimer(signal.ITIMER_PROF, 0)
        if whole is not None:
            path.write_bytes(whole)
        shared[8:24] = refused.to_bytes(8, "little") + accepted.to_bytes(8, "little")
        if faults >= MOST_FAULTS:
            break


def _report(pipe: int, kind: Kind, seed: int, case: int, said: str, fault: str) -> int:
    os.write(pipe, (json.dumps(_line(kind, seed, case, said, fault)) + "\n").encode())
    return 1


def _named(kind: Kind, seed: int, case: int, strangers: list[bytes], fault: str) -> str:
    return _line(kind, seed, case, damaged_file(kind, seed, case, strangers)[0], fault)


def _line(kind: Kind, seed: int, case: int, said: str, fault: str) -> str:
    return f"{kind.name}, seed {seed}, case {case} ({said!r}): {fault}"
