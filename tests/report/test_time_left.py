"""The time that a sweep still needs, and durations in words."""

import pytest

from src.report.sweep_file import RowConfig, SweepConfig
from src.report.sweep_record import RunState, SweepRecord
from src.report.time_left import duration, seconds_left

NOW = 10_000.0


def record_of(**states):
    """A record whose runs `<phase>_<number>` have these states; those that run began 20 s ago."""
    runs = {}
    for name, state in states.items():
        run_id = f"m-{name.replace('_', '-mini-')}"
        runs[run_id] = RunState(run_id=run_id, overrides=[], seed=0, label="a", state=state, started=NOW - 20.0)
    sweep = SweepConfig(name="a", title="t", question="q", rows=[RowConfig(label="a")])
    return SweepRecord(sweep=sweep, scale="mini", command="", seeds=[0], rows={}, runs=runs, study="", storage="")


def test_each_phase_takes_what_its_finished_runs_took():
    record = record_of(phase1_0="done", phase1_1="done", phase2_0="done", phase1_2="running", phase2_1="waiting")
    taken = {"m-phase1-mini-0": 100.0, "m-phase1-mini-1": 200.0, "m-phase2-mini-0": 600.0}
    assert seconds_left(record, taken, 1, NOW) == pytest.approx(130.0 + 600.0)
    assert seconds_left(record, taken, 2, NOW) == pytest.approx(365.0)
    assert seconds_left(record, taken, 1, NOW + 1000.0) == pytest.approx(600.0)  # it takes longer than the others did
    assert seconds_left(record, {}, 1, NOW) is None
    assert seconds_left(record, {"m-phase1-mini-0": 100.0}, 1, NOW) == pytest.approx(80.0 + 100.0)  # of any phase


@pytest.mark.parametrize(
    "seconds, expected",
    [(0.4, "0 s"), (89, "89 s"), (95, "2 min"), (5000, "83 min"), (3600 * 3.1, "3 h 06 min"), (200_000, "2 d 7 h")],
)
def test_durations(seconds, expected):
    assert duration(seconds) == expected


def test_a_clock_that_was_set_back_adds_nothing():
    record = record_of(phase1_0="done", phase1_1="running")
    assert seconds_left(record, {"m-phase1-mini-0": 100.0}, 1, NOW - 86_400.0) == pytest.approx(100.0)
    assert seconds_left(record, {"m-phase1-mini-0": 100.0}, 1, NOW + 86_400.0) == 0.0
