"""How far a sweep is, the time that it still needs, and durations in words."""

import pytest

from src.report.sweep_file import DimensionConfig, RowConfig, SweepConfig
from src.report.sweep_record import RunState, SweepRecord
from src.report.time_left import duration, progress_of, seconds_left

NOW = 10_000.0


def record_of(sweep=None, took=(), **states):
    """A record whose runs `<phase>_<number>` have these states; the first ones `took` so long, the others run 20 s."""
    runs = {}
    for name, state in states.items():
        run_id = f"m-{name.replace('_', '-mini-')}"
        runs[run_id] = RunState(run_id=run_id, overrides=[], seed=0, label="a", state=state, started=NOW - 20.0)
    for run, seconds in zip(runs.values(), took, strict=False):
        run.started, run.ended = NOW - 2000.0, NOW - 2000.0 + seconds
    sweep = sweep or SweepConfig(name="a", title="t", question="q", rows=[RowConfig(label="a")])
    return SweepRecord(sweep=sweep, scale="mini", command="", seeds=[0], rows={}, runs=runs, study="a", storage="")


STATES = {"phase1_0": "done", "phase1_1": "done", "phase2_0": "done", "phase1_2": "running", "phase2_1": "waiting"}


def test_each_phase_takes_what_its_finished_runs_took():
    runs = record_of(took=(100.0, 200.0, 600.0), **STATES).runs.values()
    assert seconds_left(runs, 1, NOW) == pytest.approx(130.0 + 600.0)
    assert seconds_left(runs, 2, NOW) == pytest.approx(365.0)
    assert seconds_left(runs, 1, NOW + 1000.0) == pytest.approx(600.0)  # it takes longer than the others did
    assert seconds_left(record_of(**STATES).runs.values(), 1, NOW) is None
    runs = record_of(took=(100.0,), **STATES).runs.values()
    assert seconds_left(runs, 1, NOW) == pytest.approx(80.0 + 100.0)  # of any phase


def test_what_is_only_scored_says_nothing_of_what_is_trained():
    runs = record_of(took=(100.0, 200.0, 600.0), **STATES).runs
    runs["m-phase1-mini-0"].overrides = ["phase.epochs=0"]
    runs["m-phase1-mini-2"].state = "waiting"
    assert seconds_left(runs.values(), 1, NOW) == pytest.approx(200.0 + 600.0)
    runs["m-phase1-mini-2"].overrides = ["phase.epochs=0"]
    assert seconds_left(runs.values(), 1, NOW) == pytest.approx(100.0 + 600.0)


def test_progress_is_told_in_a_line():
    line = progress_of(record_of(**STATES, phase1_3="failed"), 1, NOW)
    assert line == "a: 3 of 6 done, 1 running, 1 left, 1 failed, time left unknown yet"
    record = record_of(took=(100.0, 200.0, 600.0), **STATES)
    assert progress_of(record, 1, NOW).endswith("about 12 min left")
    assert progress_of(record, 2, NOW).endswith("about 6 min left")


def test_a_search_counts_the_trials_to_come():
    space = {"optim.lr": DimensionConfig(low=0.0, high=1.0)}
    sweep = SweepConfig(name="a", title="t", question="q", space=space, trials=10)
    record = record_of(sweep, phase1_0="done", phase1_1="pruned", phase1_2="running")
    record.trials = 3
    assert "1 of 10 done, 1 running, 7 left, 1 pruned" in progress_of(record, 1, NOW)


@pytest.mark.parametrize(
    "seconds, expected",
    [(0.4, "0 s"), (89, "89 s"), (95, "2 min"), (5000, "83 min"), (3600 * 3.1, "3 h 06 min"), (200_000, "2 d 7 h")],
)
def test_durations(seconds, expected):
    assert duration(seconds) == expected


def test_a_clock_that_was_set_back_adds_nothing():
    record = record_of(took=(100.0,), phase1_0="done", phase1_1="running")
    assert seconds_left(record.runs.values(), 1, NOW - 86_400.0) == pytest.approx(100.0)
    assert seconds_left(record.runs.values(), 1, NOW + 86_400.0) == 0.0
