"""The line that says how far a sweep is."""

import json

from src.report.sweep_record import RunState, SweepRecord
from src.sweep.progress import progress_line
from tests.sweep.fake_sweep import make_sweep


def record_of(sweep, states):
    runs = {
        f"fake-{phase}-debug-{i}": RunState(
            run_id=f"fake-{phase}-debug-{i}", overrides=[], seed=0, label="a", state=state, started=None
        )
        for i, (phase, state) in enumerate(states)
    }
    return SweepRecord(
        sweep=sweep, scale="debug", command="", seeds=[0], rows={}, runs=runs, study="fake-debug", storage=""
    )


def test_time_left_comes_from_finished_runs_of_the_phase(tmp_path):
    states = [("phase1", "done"), ("phase1", "done"), ("phase2", "done"), ("phase1", "waiting"), ("phase2", "waiting")]
    record = record_of(make_sweep({"a": []}), [*states, ("phase1", "failed")])
    assert "3 of 6 done, 0 running, 2 left, 1 failed, time left unknown yet" in progress_line(record, tmp_path, 1)
    for run_id, seconds in zip(record.runs, (100.0, 200.0, 600.0), strict=False):
        (tmp_path / run_id).mkdir()
        (tmp_path / run_id / "run.json").write_text(json.dumps({"seconds": {"all": seconds}}))
    assert progress_line(record, tmp_path, 1).endswith("about 12 min left")  # 150 s and 600 s
    assert progress_line(record, tmp_path, 2).endswith("about 6 min left")


def test_a_search_counts_the_trials_to_come(tmp_path):
    sweep = make_sweep(space={"optim.lr": {"low": 0.0, "high": 1.0}}, trials=10)
    record = record_of(sweep, [("phase1", "done"), ("phase1", "pruned"), ("phase1", "running")])
    record.trials = 3
    assert "1 of 10 done, 1 running, 7 left, 1 pruned" in progress_line(record, tmp_path, 1)
