"""Searches: the sampler's choices, pruning, failures, and going on, with fake trainings."""

import json
import subprocess
import sys

import pytest

from src.errors import ConfigError
from src.report.metric_names import METRICS
from src.sweep.run_status import read_score
from src.sweep.search import PruningWatch
from tests.running import wait_for
from tests.sweep.fake_sweep import ROOT, make_runner, make_sweep, trained
from tests.sweep.test_runner import fault, finish, record_of, start

pytestmark = pytest.mark.slow
SPACE = {"fake.score": {"low": 0.1, "high": 0.9}, "model.x": {"choices": [1, 2, None]}}


@pytest.fixture(autouse=True)
def at_the_root(monkeypatch):
    monkeypatch.chdir(ROOT)


def search(folder, trials, space=SPACE, common=(), workers=2, **more):
    sweep = make_sweep(space=space, objective="NDS", trials=trials, **more)
    return make_runner(folder, sweep, common=common, workers=workers)


def test_a_search_finds_its_best_and_ends_after_its_trials(tmp_path):
    runner = search(tmp_path, 8)
    record = runner.run()
    assert record.count("done") == len(record.runs) == 8 and trained(tmp_path).total() == 8
    values = {run_id: run.value for run_id, run in record.runs.items()}
    best = max(runner.study.trials(), key=lambda trial: trial.value)
    assert best.value == max(values.values()) == values[best.run_id]
    assert best.attrs["chosen"][0] == f"fake.score={best.value:.4g}"
    assert set(best.attrs["chosen"]) <= set(record.runs[best.run_id].overrides)
    assert {run.label for run in record.runs.values()} == {f"trial {number}" for number in range(8)}
    assert any("model.x=null" in run.overrides for run in record.runs.values())
    again = search(tmp_path, 8)
    assert again.run().count("done") == 8 and trained(tmp_path, "begin").total() == 8
    assert search(tmp_path, 10).run().count("done") == 10  # more trials extend it


def test_choices_are_repeatable(tmp_path):
    runs = [set(search(tmp_path / name, 3, workers=1).run().runs) for name in "ab"]
    assert runs[0] == runs[1] and len(runs[0]) == 3


def test_trials_that_promise_little_are_pruned(tmp_path):
    search(
        tmp_path, 5, {"fake.score": {"low": 0.8, "high": 0.9}}, overrides=["fake.epochs=4", "fake.seconds=0.1"]
    ).run()
    # The same study must not see another space; widen it behind its back to have a bad trial for certain.
    runner = search(
        tmp_path, 6, {"fake.score": {"low": 0.8, "high": 0.9}}, overrides=["fake.epochs=4", "fake.seconds=6"]
    )
    runner.sweep.space["fake.score"].low, runner.sweep.space["fake.score"].high = 0.1, 0.2
    record = runner.run()
    assert record.count("done") == 5 and record.count("pruned") == 1
    (pruned,) = [run for run in record.runs.values() if run.state == "pruned"]
    assert 0.1 <= pruned.value <= 0.2 and trained(tmp_path, "interrupted") == {pruned.run_id: 1}
    assert max(trial.value or 0.0 for trial in runner.study.trials()) >= 0.8


@pytest.mark.parametrize(
    "name", ["NDS", "measures.moving_AP", "speeds.25+.car.AP", "ranges.0-25.mAP", "classes.car.AP"]
)
def test_an_objective_is_read_by_the_name_that_tables_give_it(tmp_path, name):
    of_class = {"classes": {"car": {"AP": 0.5}}}
    scores = {"NDS": 0.5, "measures": {"moving_AP": 0.5}, "ranges": {"0-25": {"mAP": 0.5}}, "speeds": {"25+": of_class}}
    (tmp_path / "metrics.json").write_text(json.dumps(scores | of_class))
    assert name in METRICS and read_score(tmp_path, name) == 0.5 and read_score(tmp_path, f"{name}s") is None


def test_an_objective_that_is_no_number_is_a_failed_trial_and_not_tried_again(tmp_path):
    space = {"fake.score": {"choices": ["nan", "nan"]}}
    record = search(tmp_path, 2, space, workers=1).run()
    assert record.count("failed") == 1 and len(record.runs) == 1  # both trials are one run
    assert record.trials == 2 and record.unchosen == 0 and record.planned == 1
    assert "no finite" in next(iter(record.runs.values())).reason
    begun = trained(tmp_path, "begin").total()
    search(tmp_path, 2, space).run()
    assert trained(tmp_path, "begin").total() == begun == 1


@pytest.mark.parametrize(("code", "again"), [("5", False), ("4", True)])
def test_only_the_exit_code_of_a_diverged_run_is_an_answer(tmp_path, code, again):
    space = {"model.x": {"choices": [1, 1]}}
    fault(tmp_path, ["model.x=1", "seed=0"], code)  # what it prints is that it diverged, both times
    assert search(tmp_path, 1, space, workers=1).run().count("failed") == 1
    search(tmp_path, 1, space, workers=1).run()
    assert trained(tmp_path, "begin").total() == 1 + again


def test_a_database_that_is_away_for_a_moment_ends_no_run(tmp_path):
    (tmp_path / "metrics.csv").write_text("epoch,val/NDS\n0,0.25\n1,0.5\n")
    answers = [ConfigError("the server is away"), False, True]

    class Study:
        def report(self, trial, value, step):
            answer = answers.pop(0)
            if isinstance(answer, Exception):
                raise answer
            return answer

    watch = PruningWatch(Study(), None, tmp_path, "NDS")
    assert watch() is False and watch.last == 0.0  # tried again at the next look, with the same numbers
    assert watch() is True and watch.last == 0.5 and not answers
    assert watch() is True and watch.pruned  # nothing has changed since; what was said stays said


def test_a_killed_search_goes_on_with_the_same_values(tmp_path):
    what = {"space": SPACE, "sweep": {"objective": "NDS", "trials": 2, "overrides": ["fake.seconds=1"]}}
    runner = start(tmp_path, **what)
    wait_for(lambda: trained(tmp_path, "begin"))
    (first,) = trained(tmp_path, "begin")
    runner.kill()
    runner.communicate()
    finish(start(tmp_path, **what))
    assert trained(tmp_path)[first] == 1 and len(trained(tmp_path)) == 2
    assert record_of(tmp_path).runs[first].label == "trial 0"


def test_what_trials_start_from_is_trained_once_and_failures_are_tried_again(tmp_path):
    space = {"model.dptf.x": {"low": 0.0, "high": 1.0}}
    common = ["phase=phase2"]
    source = fault(tmp_path, ["phase=phase1", "seed=0"], "4", "4", "4")
    record = search(tmp_path, 3, space, common, workers=1).run()
    assert record.count("failed") == 3 and record.runs[source].state == "waiting"
    assert all(source in run.reason for run in record.runs.values() if run.state == "failed")
    record = search(tmp_path, 3, space, common).run()
    assert record.count("done") == 4 and set(trained(tmp_path).values()) == {1}
    assert record.runs[source].label.startswith("weights for") and not record.rows


def test_values_that_do_not_compose_are_failed_trials(tmp_path):
    record = search(tmp_path, 2, {"optmi.lr": {"low": 0.0, "high": 1.0}}).run()
    assert record.count("failed") == 2 and not trained(tmp_path)
    assert all("not a configuration key" in run.reason for run in record.runs.values())


def test_two_searching_processes_share_the_trials(tmp_path):
    what = {"folder": str(tmp_path), "space": SPACE, "sweep": {"objective": "NDS", "trials": 6}}
    command = [sys.executable, "-m", "tests.sweep.fake_sweep", json.dumps(what)]
    runners = [subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    for runner in runners:
        error = runner.communicate(timeout=90)[1]
        assert runner.returncode == 0, error
    assert len(trained(tmp_path)) == trained(tmp_path).total() == 6
