"""The runner with real processes and a real study; what it starts is a fake training of some tenths of a second."""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from src.errors import ConfigError, DataError
from src.report.results import result_path
from src.report.sweep_file import TableConfig
from src.report.sweep_record import read_record, record_path, write_record
from src.sweep.launcher import ExitStatus
from tests.running import wait_for
from tests.sweep.fake_sweep import ROOT, make_runner, make_sweep, trained
from tests.sweep.fake_train import identify

pytestmark = pytest.mark.slow
TWELVE = {f"{i}": [f"model.x={i}"] for i in range(12)}


@pytest.fixture(autouse=True)
def at_the_root(monkeypatch):
    monkeypatch.chdir(ROOT)


def start(folder, **what):
    what = json.dumps({"folder": str(folder), **what})
    return subprocess.Popen(
        [sys.executable, "-m", "tests.sweep.fake_sweep", what],
        cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def finish(process, expect=0):
    out, err = process.communicate(timeout=90)
    assert process.returncode == expect, out + err
    return err


def record_of(folder):
    return read_record(record_path(Path(folder) / "reports", "fake", "debug"))


def fault(folder, overrides, *codes):
    path = Path(folder) / "outputs" / "faults" / identify(overrides).run_id
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(codes))
    return path.name


def test_everything_is_trained_once_and_then_nothing(tmp_path):
    sweep = make_sweep({"a": ["model.x=1"], "b": ["model.x=2"], "same as a": ["model.x=1"]})
    published = []
    record = make_runner(tmp_path, sweep, seeds=(0, 1), workers=2, publish=published.append).run()
    assert sorted(trained(tmp_path).values()) == [1, 1, 1, 1] and len(published) == 4
    assert record.rows["a"] == record.rows["same as a"] and len(record.runs) == 4
    assert {run.state for run in record.runs.values()} == {"done"}
    assert record == record_of(tmp_path)
    run = next(iter(record.runs.values()))
    assert run.overrides == ["model.x=1", "seed=0"] and run.worker is None and run.ended > run.started
    assert "environment" in (tmp_path / "outputs" / run.log).read_text()
    make_runner(tmp_path, sweep, seeds=(0, 1)).run()
    assert trained(tmp_path, "begin").total() == 4


def test_what_rows_start_from_comes_first_and_is_shared(tmp_path):
    rows = {"one": ["phase=phase1"], "two": ["phase=phase2"], "three": ["phase=phase2", "model.dptf=null"]}
    record = make_runner(tmp_path, make_sweep(rows), workers=3).run()
    assert list(record.runs) == [record.rows[row][0] for row in rows]
    assert {run.needs for run in record.runs.values()} == {None, record.rows["one"][0]}
    assert set(trained(tmp_path).values()) == {1} and record.count("done") == 3


def test_rows_with_a_result_are_done_without_training(tmp_path):
    rows = {"one": ["phase=phase1"], "two": ["phase=phase2"], "three": ["phase=phase2", "model.dptf=null"]}
    results = make_runner(tmp_path / "elsewhere", make_sweep(rows)).plan.rows
    published = []
    runner = make_runner(
        tmp_path, make_sweep(rows), results={results["one"][0], results["two"][0]}, publish=published.append
    )
    record = runner.run()
    assert record.count("done") == 3 and record.runs[results["two"][0]].log is None
    assert trained(tmp_path) == {results["one"][0]: 1, results["three"][0]: 1}  # row three starts from row one
    assert {path.name for path in published} == {results["one"][0], results["three"][0]}


def test_without_workers_what_there_is_is_recorded(tmp_path):
    """A row with a result counts though another would be trained from its weights."""
    rows = {"one": ["phase=phase1"], "two": ["phase=phase2"], "three": ["phase=phase1", "optim.lr=1"]}
    plan = make_runner(tmp_path / "elsewhere", make_sweep(rows)).plan
    one = plan.rows["one"][0]
    record = make_runner(tmp_path, make_sweep(rows), results={one}, workers=0).run()
    assert {label: record.runs[runs[0]].state for label, runs in record.rows.items()} == {
        "one": "done", "two": "waiting", "three": "waiting"
    }  # fmt: skip
    assert not trained(tmp_path) and record == record_of(tmp_path)


@pytest.mark.parametrize("published", [True, False])
def test_what_is_published_after_the_plan_was_made_is_no_longer_waiting(tmp_path, published):
    """But for a run that is to be trained all the same, as another begins from its weights."""
    rows = {"one": ["phase=phase1"], "two": ["phase=phase2"], "other": ["phase=phase1", "optim.lr=1"]}
    runner = make_runner(tmp_path, make_sweep(rows), published=published, workers=0)
    for label in ("one", "other"):
        path = result_path(tmp_path / "reports", runner.plan.rows[label][0])
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("{}")
    states = [run.state for run in runner.run().runs.values()]
    assert states == ["waiting", "waiting", "done" if published else "waiting"]


def test_a_failed_row_is_reported_and_retried_by_the_next_call(tmp_path):
    rows = {"good": ["model.x=1"], "bad": ["model.x=2"], "killed": ["model.x=3"]}
    bad = fault(tmp_path, ["model.x=2", "seed=0"], "5", "3")
    killed = fault(tmp_path, ["model.x=3", "seed=0"], "kill")
    record = make_runner(tmp_path, make_sweep(rows)).run()
    assert record.count("done") == 1 and record.runs[bad].state == "failed"
    assert record.runs[bad].reason == "DivergedError: the loss is nan at step 3 (exit code 5, diverged)"
    assert "Epoch 0: 100%" in (tmp_path / "outputs" / record.runs[bad].log).read_text()
    assert record.runs[killed].reason == "killed by SIGKILL (out of memory?)"
    record = make_runner(tmp_path, make_sweep(rows)).run()
    assert record.runs[bad].state == "failed" and "exit code 3" in record.runs[bad].reason
    assert record.runs[killed].state == "done" and record.runs[killed].reason is None
    assert make_runner(tmp_path, make_sweep(rows)).run().count("done") == 3
    assert trained(tmp_path, "begin")[bad] == 3 and set(trained(tmp_path).values()) == {1}


def test_what_starts_from_a_failed_run_fails_with_its_reason(tmp_path):
    rows = {"two": ["phase=phase2"], "good": ["model.x=2"]}
    first = fault(tmp_path, ["phase=phase1", "seed=0"], "4")
    record = make_runner(tmp_path, make_sweep(rows)).run()
    two = record.runs[record.rows["two"][0]]
    assert two.state == "failed" and first in two.reason and "the loss is nan" in two.reason
    assert record.runs[first].label == "weights for two" and record.count("done") == 1
    assert make_runner(tmp_path, make_sweep(rows)).run().count("done") == 3


def test_an_interrupted_run_is_resumed_but_not_for_ever(tmp_path):
    rows = {"twice": ["model.x=1"], "always": ["model.x=2"]}
    fault(tmp_path, ["model.x=1", "seed=0"], "6", "6")
    always = fault(tmp_path, ["model.x=2", "seed=0"], *["6"] * 9)
    record = make_runner(tmp_path, make_sweep(rows)).run()
    assert record.count("done") == 1 and record.runs[always].state == "failed"
    assert trained(tmp_path, "begin")[always] == 3


def test_a_score_that_is_no_number_is_a_failure(tmp_path):
    record = make_runner(tmp_path, make_sweep({"nan": ["fake.score=nan"]})).run()
    (run,) = record.runs.values()
    assert run.state == "failed" and "no finite mAP" in run.reason


def test_a_run_of_another_task_is_done_by_its_own_headline(tmp_path, caplog):
    sweep = make_sweep(
        {"good": ["fake.score=0.5"], "nan": ["fake.score=nan"]}, overrides=["phase.task=segmentation"],
        task="segmentation", tables=[TableConfig(name="t", title="t", columns=["IoU"])],
    )  # fmt: skip
    with caplog.at_level("INFO"):
        record = make_runner(tmp_path, sweep).run()
    good, bad = record.runs.values()
    assert good.state == "done" and good.value == 0.5 and "IoU 0.500" in caplog.text
    assert bad.state == "failed" and "no finite IoU" in bad.reason


def test_rows_and_seeds_extend_a_sweep_and_earlier_seeds_stay(tmp_path):
    rows = {"a": ["model.x=1"], "b": ["model.x=2"]}
    make_runner(tmp_path, make_sweep(rows)).run()
    rows["c"] = ["model.x=3"]
    assert make_runner(tmp_path, make_sweep(rows), seeds=(0, 1)).run().count("done") == 6
    assert trained(tmp_path, "begin").total() == 6
    again = make_runner(tmp_path, make_sweep(rows)).run()
    assert again.seeds == [0, 1] and again.count("done") == len(again.runs) == 6
    rows["b"] = ["model.x=4"]  # another definition: of this row only what the command says
    changed = make_runner(tmp_path, make_sweep(rows)).run()
    assert {label: sorted(runs) for label, runs in changed.rows.items()} == {"a": [0, 1], "b": [0], "c": [0, 1]}
    assert changed.seeds == [0, 1] and len(changed.runs) == 5


def test_earlier_seeds_that_were_trained_elsewhere_stay_by_their_results(tmp_path):
    sweep = make_sweep({"a": ["model.x=1"]})
    before = make_runner(tmp_path, sweep, seeds=(0, 1, 2)).run()
    shutil.rmtree(tmp_path / "outputs")
    for seed in (0, 1):  # the result of seed 2 is gone
        path = result_path(tmp_path / "reports", before.rows["a"][seed])
        path.parent.mkdir(exist_ok=True)
        path.write_text("{}")
    record = make_runner(tmp_path, sweep, seeds=(3,)).run()
    assert record.rows == {"a": {3: record.rows["a"][3], **{seed: before.rows["a"][seed] for seed in (0, 1)}}}
    assert record.count("done") == 3 and record.seeds == [0, 1, 3]


def test_earlier_seeds_of_a_row_that_scores_weights_stay(tmp_path):
    sweep = make_sweep({"a": ["model.x=1"], "scored": ["model.x=2"]})
    sweep.rows[1].weights = "a"
    make_runner(tmp_path, sweep, seeds=(0, 1)).run()
    record = make_runner(tmp_path, sweep, seeds=(0,)).run()
    assert sorted(record.rows["scored"]) == [0, 1] and record.count("done") == 4


def test_a_failed_seed_of_an_earlier_command_is_no_failure_of_one_without_it(tmp_path):
    sweep = make_sweep({"a": ["model.x=1"]})
    bad = fault(tmp_path, ["model.x=1", "seed=1"], "5")
    assert make_runner(tmp_path, sweep, seeds=(0, 1)).run().runs[bad].state == "failed"
    assert list(make_runner(tmp_path, sweep, seeds=(0,)).run().rows["a"]) == [0]
    assert make_runner(tmp_path, sweep, seeds=(0, 1)).run().count("done") == 2


def test_what_failed_in_a_sweep_of_the_same_call_is_not_trained_again(tmp_path):
    rows = {"bad": ["model.x=1"], "two": ["model.x=1", "phase=phase2"], "good": ["model.x=2"]}
    first = make_runner(tmp_path, make_sweep({"bad": ["model.x=1"]}))
    bad = fault(tmp_path, ["model.x=1", "seed=0"], "5")
    first.run()
    again = make_runner(tmp_path, make_sweep(rows), common=["optim.lr=0.01"])
    assert first.failed.keys() == {bad} and not again.failed
    second = make_runner(tmp_path, make_sweep(rows))
    second.failed = first.failed
    record = second.run()
    assert record.runs[bad].reason == first.failed[bad] and trained(tmp_path, "begin")[bad] == 1
    assert record.count("done") >= 1 and trained(tmp_path)[record.rows["good"][0]] == 1
    assert make_runner(tmp_path, make_sweep(rows)).run().count("failed") == 0  # the next call does


def test_another_command_line_is_another_sweep_beside_the_first(tmp_path):
    sweep = make_sweep({"a": ["model.x=1"]})
    plain = make_runner(tmp_path, sweep).run()
    runner = make_runner(tmp_path, sweep, common=["optim.lr=0.01"])
    changed = runner.run()
    assert changed.changes == ["optim.lr=0.01"] and changed.rows != plain.rows and changed.study == runner.study.name
    assert record_of(tmp_path) == plain  # not replaced
    assert read_record(runner.writer.path) == changed and runner.writer.path.stem == changed.stem != plain.stem
    assert make_runner(tmp_path, sweep).run().seeds == [0] and changed.study != plain.study


def test_an_earlier_seed_of_another_definition_leaves_the_table(tmp_path):
    make_runner(tmp_path, make_sweep({"a": ["model.x=1"], "b": ["model.x=2"]}), seeds=(0,)).run()
    record = make_runner(tmp_path, make_sweep({"a": ["model.x=1"], "b": ["model.x=3"]}), seeds=(1,)).run()
    assert sorted(record.rows["a"]) == [0, 1] and sorted(record.rows["b"]) == [1]


def test_a_source_of_an_earlier_seed_is_looked_at_again(tmp_path):
    sweep = make_sweep({"two": ["phase=phase2"]})
    record = make_runner(tmp_path, sweep, seeds=(0,)).run()
    source = record.runs[record.runs[record.rows["two"][0]].needs]
    source.state, source.worker = "running", "a host:1"
    write_record(record_path(tmp_path / "reports", "fake", "debug"), record)
    again = make_runner(tmp_path, sweep, seeds=(1,)).run()
    assert again.runs[source.run_id].state == "done" and again.runs[source.run_id].worker is None


def test_words_of_a_failure_decide_nothing(tmp_path):
    """A setting's error that quotes what a busy folder or a diverged run would say is a failure like others."""
    folder = tmp_path / "outputs" / fault(tmp_path, ["model.x=1", "seed=0"], "3")
    code = f"print('ConfigError: {folder} is being trained by another process; it diverged'); raise SystemExit(3)"
    runner = make_runner(tmp_path, make_sweep({"a": ["model.x=1"]}))
    runner.launcher.command = [sys.executable, "-c", code]
    (run,) = runner.run().runs.values()
    assert run.state == "failed" and "is being trained by another process" in run.reason


def test_a_busy_folder_is_waited_for_even_when_it_is_free_at_the_next_poll(tmp_path):
    runner = make_runner(tmp_path, make_sweep({"a": ["model.x=1"]}))
    own, starts = runner.launcher.run, []

    def run(*arguments):
        starts.append(1)
        reason = "BusyError: the folder is being trained by another process (exit code 3)"
        busy = ExitStatus(3, reason, stop_requested=False)
        return busy if len(starts) == 1 else own(*arguments)

    runner.launcher.run = run
    assert runner.run().count("done") == 1 and len(starts) == 2


def test_a_run_that_someone_else_trains_is_waited_for(tmp_path):
    rows = {"a": ["model.x=1"]}
    outputs = tmp_path / "outputs"
    outputs.mkdir()
    by_hand = [sys.executable, "-m", "tests.sweep.fake_train", "model.x=1", "seed=0"]
    process = subprocess.Popen([*by_hand, f"paths.outputs={outputs}", "fake.seconds=2"], cwd=ROOT)
    other = identify(["model.x=1", "seed=0", "fake.seconds=2"]).run_id
    wait_for(lambda: (outputs / other / ".lock").exists())
    rows["a"].append("fake.seconds=2")
    record = make_runner(tmp_path, make_sweep(rows)).run()
    assert process.wait() == 0 and record.count("done") == 1
    assert trained(tmp_path, "begin") == {other: 1}


def test_several_runners_at_once_train_every_run_once(tmp_path):
    runners = [start(tmp_path, rows=TWELVE, barrier=True, workers=2) for _ in range(3)]
    for runner in runners:
        assert runner.stdout.readline() == "ready\n"
    for runner in runners:
        runner.stdin.write("go\n")
        runner.stdin.flush()
    for runner in runners:
        finish(runner)
    assert len(trained(tmp_path, "begin")) == 12 and set(trained(tmp_path, "begin").values()) == {1}
    assert record_of(tmp_path).count("done") == 12


def test_two_workers_killed_at_random_times_finish_every_row_once(tmp_path):
    rng = random.Random(5)
    what = {"rows": TWELVE, "sweep": {"overrides": ["fake.seconds=0.4"]}}
    runners = [start(tmp_path, **what) for _ in range(2)]
    for kill in range(5):
        before = trained(tmp_path, "begin").total()
        wait_for(lambda before=before: trained(tmp_path, "begin").total() > before)
        time.sleep(rng.uniform(0.0, 0.5))
        runners[kill % 2].kill()
        runners[kill % 2].communicate()
        runners[kill % 2] = start(tmp_path, **what)
    for runner in runners:
        finish(runner)
    assert len(trained(tmp_path)) == 12 and set(trained(tmp_path).values()) == {1}
    record = record_of(tmp_path)
    assert record.count("done") == 12 and len(record.runs) == 12


def test_children_of_a_killed_runner_end_and_the_same_command_goes_on_at_once(tmp_path):
    what = {"rows": {"a": ["model.x=1"]}, "sweep": {"overrides": ["fake.seconds=30"]}}
    runner = start(tmp_path, **what)
    wait_for(lambda: trained(tmp_path, "begin"))
    pid = int((tmp_path / "outputs" / "trained.txt").read_text().split()[-1])
    runner.kill()
    runner.communicate()
    wait_for(lambda: trained(tmp_path, "interrupted"), timeout=10)
    wait_for(lambda: not Path(f"/proc/{pid}").exists(), timeout=10)
    began = time.monotonic()
    again = start(tmp_path, **what)
    wait_for(lambda: trained(tmp_path, "begin").total() == 2)
    assert time.monotonic() - began < 30  # far below the grace of a worker elsewhere
    again.kill()
    assert "is gone" in again.communicate()[1]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_sweep_lets_runs_write_checkpoints_and_goes_on(tmp_path, number):
    what = {"rows": {"a": ["model.x=1"], "b": ["model.x=2"]}, "workers": 2}
    runner = start(tmp_path, **what, sweep={"overrides": ["fake.seconds=30"]})
    wait_for(lambda: trained(tmp_path, "begin").total() == 2)
    runner.send_signal(number)
    assert "stopping" in finish(runner, expect=6)
    assert trained(tmp_path, "interrupted").total() == 2
    record = record_of(tmp_path)
    assert record.count("waiting") == 2 and all(run.worker is None for run in record.runs.values())
    finish(start(tmp_path, **what))
    assert record_of(tmp_path).count("done") == 2


def test_a_broken_record_is_replaced_and_one_that_cannot_be_written_ends_nothing(tmp_path, monkeypatch):
    path = record_path(tmp_path / "reports", "fake", "debug")
    path.parent.mkdir(parents=True)
    path.write_text("{")
    make_runner(tmp_path, make_sweep({"a": []})).run()
    assert record_of(tmp_path).count("done") == 1

    def full(path, record):
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr("src.sweep.record_writer.write_record", full)
    record = make_runner(tmp_path, make_sweep({"a": [], "b": ["model.x=2"]})).run()
    assert record.count("done") == 2
    monkeypatch.setattr("src.sweep.record_writer.write_record", write_record)


def test_a_result_that_cannot_be_published_costs_no_other(tmp_path):
    def full(path):
        raise OSError(28, "No space left on device", str(path))

    runner = make_runner(tmp_path, make_sweep({"a": [], "b": ["model.x=2"]}), publish=full)
    assert runner.run().count("done") == 2
    with pytest.raises(OSError, match="No space"):
        runner.publish_and_list_faults(strictly=True)


def test_a_run_whose_files_are_broken_is_named_and_costs_no_other(tmp_path):
    def publish(path):
        if path.name == runner.specs()[0].run_id:
            raise DataError(f"{path}/run.json: not readable as JSON")
        published.append(path.name)

    published = []
    runner = make_runner(tmp_path, make_sweep({"a": [], "b": ["model.x=2"]}), publish=publish)
    assert runner.run().count("done") == 2 and published == [runner.specs()[1].run_id]
    (fault,) = runner.publish_and_list_faults(strictly=True)
    assert fault.startswith(f"the result of {runner.specs()[0].run_id}") and "run.json: not readable" in fault


def test_a_study_of_another_definition_is_refused(tmp_path):
    make_runner(tmp_path, make_sweep({"a": []})).run()
    with pytest.raises(ConfigError, match=r"study fake-debug .*another definition.*kind was 'rows' and is 'search'"):
        make_runner(tmp_path, make_sweep(space={"fake.score": {"low": 0.0, "high": 1.0}}, trials=2))


def test_a_defect_in_a_worker_ends_the_sweep_with_its_error(tmp_path, monkeypatch):
    runner = make_runner(tmp_path, make_sweep({"a": []}))
    monkeypatch.setattr(runner.launcher, "run", lambda *a: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        runner.run()
    assert make_runner(tmp_path, make_sweep({"a": []})).run().count("done") == 1


def test_cores_and_gpus_are_divided(tmp_path, monkeypatch):
    from src.sweep.launcher import Launcher

    monkeypatch.setattr("src.sweep.launcher._cores", lambda: 8)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    launcher = Launcher([], tmp_path, 3, ["0", "1", "2", "3"], group="fake-debug")
    shares = [launcher.environment(worker) for worker in range(3)]
    assert [share["CUDA_VISIBLE_DEVICES"] for share in shares] == ["0,3", "1", "2"]
    assert shares[0]["OMP_NUM_THREADS"] == "2"
    monkeypatch.setenv("OMP_NUM_THREADS", "5")
    assert launcher.environment(0)["OMP_NUM_THREADS"] == "5"
    alone = Launcher([], tmp_path, 0, ["0", "1"])  # trains nothing, measures
    assert alone.environment(0)["CUDA_VISIBLE_DEVICES"] == "0,1"
    few = Launcher([], tmp_path, 3, ["GPU-a"])
    assert {few.environment(worker)["CUDA_VISIBLE_DEVICES"] for worker in range(3)} == {"GPU-a"}
    assert os.environ["OMP_NUM_THREADS"] == "5"
