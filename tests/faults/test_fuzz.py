"""Thousands of damaged files of every kind: each is read with values that can be, or refused by name.

A case follows from the seed, the kind and its number; a failing one is printed with all three, and
`replay("<kind>", seed, case)` writes and reads its file again in this process, for a debugger.
"""

from __future__ import annotations

import os
import signal
import tempfile
import time
from pathlib import Path

import pytest
import torch

from tests.faults.fuzz_kinds import kinds, strangers
from tests.faults.fuzzing import Kind, damaged_file, run_cases
from tests.faults.mutations import damaged

KINDS = {kind.name: kind for kind in kinds()}
STRANGERS = strangers(list(KINDS.values()))
SEED = 20_260
FEW, MANY = 100, 2000
SLOW = {"table cache", "checkpoint's configuration", "sweep file"}
"""Kinds with a fifth of the few cases and half of the many; so are the 14 tables, whose code is one."""
NEVER_REFUSED = {"table cache", "dashboard picture", "table weather_annotation"}
"""Built again, left out, not read."""


def is_slow(name: str) -> bool:
    return name in SLOW or name.startswith("table ")


def check(kind: Kind, seed: int, cases: int, folder: Path) -> None:
    torch.set_num_threads(1)  # a forked child has no other threads
    outcome = run_cases(kind, seed, range(cases), folder, STRANGERS)
    print(f"{kind.name}: seed {seed}, {cases} cases, {outcome.refused} refused, {outcome.accepted} read")
    assert not outcome.faults, "\n".join(outcome.faults)
    assert outcome.refused + outcome.accepted == cases
    assert (outcome.refused > 0) == (kind.name not in NEVER_REFUSED)
    assert outcome.accepted > 0 or cases < 100  # few tables survive a change of a link


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_a_hundred_damaged_files_of_each_kind(name, tmp_path):
    check(KINDS[name], SEED, FEW // 5 if is_slow(name) else FEW, tmp_path)


@pytest.mark.faults
@pytest.mark.parametrize("name", KINDS)
def test_thousands_of_damaged_files_of_each_kind(name, tmp_path):
    """A new seed each time; it is printed, and `HORIZON3D_FUZZ_SEED` gives an old one again."""
    seed = int(os.environ.get("HORIZON3D_FUZZ_SEED", time.time_ns() % 2**32))
    check(KINDS[name], seed, MANY // 2 if is_slow(name) else MANY, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_whole_files_are_read(name, tmp_path):
    """Otherwise every refusal above would prove nothing."""
    kind = KINDS[name]

    def whole(rng, content, others):
        return "nothing", content

    examples = range(2 * len(kind.examples))
    outcome = run_cases(replaced(kind, mutate=whole), SEED, examples, tmp_path, STRANGERS)
    assert not outcome.faults and outcome.accepted == len(examples), outcome


def replaced(kind: Kind, **changes) -> Kind:
    return Kind(**(vars(kind) | changes))


def replay(name: str, seed: int, case: int) -> None:
    """Read one case's file in this process."""
    kind = KINDS[name]
    said, content = damaged_file(kind, seed, case, STRANGERS)
    folder = Path(tempfile.mkdtemp(prefix="replay"))
    kind.prepare(folder)
    path = folder / kind.place
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    print(f"{path}: {said}")
    kind.read(path)


# -------------------------------------------------------------------- the fuzzing itself


def kind_of(read, **changes) -> Kind:
    named = {"name": "toy", "examples": [b"0123456789" * 9], "mutate": damaged, "place": "toy.bin"}
    return Kind(**(named | changes), read=read)


def test_a_reader_that_crashes_is_caught_with_its_case(tmp_path):
    def read(path):
        if len(path.read_bytes()) == 0:
            os.kill(os.getpid(), signal.SIGSEGV)

    outcome = run_cases(kind_of(read), 1, range(200), tmp_path, [b"x"])
    assert outcome.faults and all("kills the process: SIGSEGV" in fault for fault in outcome.faults)
    case = int(outcome.faults[0].split("case ")[1].split()[0])
    assert damaged_file(kind_of(read), 1, case, [b"x"])[1] == b""
    assert damaged_file(kind_of(read), 1, case - 1, [b"x"])[1] != b""


@pytest.mark.faults
def test_a_reader_that_hangs_is_ended(tmp_path, monkeypatch):
    monkeypatch.setattr("tests.faults.fuzzing.CPU_S", 0.1)

    def computes(path):
        while True:
            pass

    (fault,) = run_cases(kind_of(computes), 1, range(1), tmp_path, [b"x"]).faults
    assert "computes for more than" in fault
    monkeypatch.setattr("tests.faults.fuzzing.WALL_S", 0.3)
    (fault,) = run_cases(kind_of(lambda path: signal.pause()), 1, range(1), tmp_path, [b"x"]).faults
    assert "waits for" in fault


def test_a_reader_that_takes_all_memory_or_names_no_file_is_reported(tmp_path):
    def takes(path):
        bytearray(2**34)  # more than an allocator may have kept

    def mute(path):
        from src.errors import DataError

        raise DataError("something is wrong")

    (fault,) = run_cases(kind_of(takes), 1, range(1), tmp_path, [b"x"]).faults
    assert "MemoryError" in fault and "seed 1, case 0" in fault
    (fault,) = run_cases(kind_of(mute), 1, range(1), tmp_path, [b"x"]).faults
    assert "does not name the file" in fault


def test_an_impossible_value_is_reported_and_others_are_counted(tmp_path):
    def read(path):
        assert len(path.read_bytes()) <= 90, "too long"

    outcome = run_cases(kind_of(read), 1, range(40), tmp_path, [b"x"])
    assert outcome.faults and outcome.accepted > 0 and "too long" in outcome.faults[0]
