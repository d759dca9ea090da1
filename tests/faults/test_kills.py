"""Killed anywhere, a training resumes from its newest whole checkpoint and ends as if nothing had happened."""

import signal
from collections import Counter

import pytest

from src.reliability.checkpoints import LAST, PREVIOUS, read_checkpoint
from tests.faults.killing import GRACE_S, POINTS, Chain, InWrite, rows, run_folder, start, wait, write_armed
from tests.running import ended

KILLS = 200
"""In all, over both phases."""
OF_ONE_RUN = 12
"""After so many a run may end, and another begins."""
SEED = 20


def kill_often(tiny, folder, phase, kills, seed):
    """Kill runs of a phase so often; what was done, each time."""
    overrides, reference = tiny(phase)
    done, number = [], 0
    while len(done) < kills:
        chain = Chain(folder / f"{phase}-{number}", overrides, reference, f"{seed}-{phase}-{number}")
        most = min(OF_ONE_RUN, kills - len(done))
        while len(chain.kills) < most and chain.kill_once():
            pass
        found = chain.finish()
        for name, value in reference["outcome"].items():
            assert found[name] == value, f"{name} differs in run {number} after {chain.kills} (seed {seed}, {phase})"
        done += chain.kills
        number += 1
    return done, number


def summary(phase, done, runs):
    kinds = ", ".join(f"{count} {kind}" for kind, count in sorted(Counter(kind for kind, _ in done).items()))
    inside = sum("in a write" in where for _, where in done)
    return f"{phase}: {len(done)} ends ({kinds}) of {runs} runs, {inside} inside a write; all bit-identical"


@pytest.mark.faults
@pytest.mark.parametrize("phase", ["phase1", "phase2"])
def test_random_kills_change_nothing(tiny, tmp_path, phase):
    print(f"seed {SEED}")
    done, runs = kill_often(tiny, tmp_path, phase, KILLS // 2, SEED)
    print(summary(phase, done, runs))
    for what, count in sorted(Counter(done).items()):
        print(f"  {count:4d} {': '.join(what)}")
    inside = sum("in a write" in where for _, where in done)
    assert inside >= len(done) / 4


@pytest.mark.slow
@pytest.mark.parametrize("point", POINTS)
def test_a_kill_at_each_point_of_a_write_leaves_a_whole_checkpoint(tmp_path, point):
    fault = InWrite(signal.SIGKILL, save=2, point=point, after_bytes=100)
    killed = ended(write_armed, fault, tmp_path / LAST)
    assert killed.returncode == -signal.SIGKILL, killed.stderr[-3000:]
    assert read_checkpoint(tmp_path / LAST)["global_step"] == (2 if point == "replaced" else 1)


@pytest.mark.faults
def test_a_kill_inside_a_write_and_a_torn_file_cost_nothing(tiny, tmp_path):
    """With the full model on clips: the newest file half written, then torn after its write, then a SIGTERM."""
    overrides, reference = tiny("phase2")
    outputs, log = tmp_path / "run", tmp_path / "run.log"
    command = [*overrides, f"paths.outputs={outputs}"]
    half = InWrite(signal.SIGKILL, save=2, point="bytes", after_bytes=reference["size"] // 2)
    assert wait(start(command, log, half), log) == -signal.SIGKILL
    checkpoints = run_folder(outputs) / "checkpoints"
    assert (checkpoints / f"{LAST}.tmp").stat().st_size > 0
    first = read_checkpoint(checkpoints / LAST)["global_step"]

    third = InWrite(signal.SIGKILL, save=2, point="replaced", after_bytes=0)
    assert wait(start(command, log, third), log) == -signal.SIGKILL
    assert not list(checkpoints.glob("*.tmp"))
    assert read_checkpoint(checkpoints / PREVIOUS)["global_step"] >= first
    torn = (checkpoints / LAST).read_bytes()
    (checkpoints / LAST).write_bytes(torn[: len(torn) // 3])

    # Told to stop inside a write, it ends the write, the step, and then itself.
    stop = InWrite(signal.SIGTERM, save=1, point="synced", after_bytes=0)
    assert wait(start(command, log, stop), log, timeout=GRACE_S + 240) == 6
    said = log.read_text()
    assert f"{LAST} is truncated" in said and f"resuming from {checkpoints / PREVIOUS} instead" in said
    steps = read_checkpoint(checkpoints / LAST)["global_step"]
    assert steps >= first and f"stopped after {steps} steps" in said and rows(outputs) >= steps

    chain = Chain(outputs, overrides, reference, 0)
    assert chain.finish() == reference["outcome"]
