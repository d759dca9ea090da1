"""Reading finished runs, and refusing what is not as a run writes it."""

import json

import pytest

from src.errors import DataError
from src.reporting.results import read_runs


def damage(path, change):
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


@pytest.mark.parametrize("content", ["", "[]", '{"scale": "mini", "run_id": "x-phase1-y"}'])
def test_broken_records_are_named(tmp_path, write_run, content):
    folder = write_run("a", [], 0, 0.3)
    (folder / "run.json").write_text(content)
    with pytest.raises(DataError, match=r"run\.json"):
        read_runs(tmp_path, "mini", ["phase1"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m["classes"]["car"].update(AP="0.3"), r"classes\.car\.AP must be float or int, but is '0\.3'"),
        (lambda m: m["ranges"]["0-25"].clear(), r"ranges\.0-25\.mAP is missing"),
        (lambda m: m.update(ranges=[]), r"ranges must be dict"),
        (lambda m: m.update(mAP=None), r"mAP must be float or int, but is None"),
        (lambda m: m["speeds"]["25+"].pop("mAVE_present"), r"speeds\.25\+\.mAVE_present is missing"),
        (lambda m: m["speeds"]["0-0.5"].update(mAP_present=True), r"speeds\.0-0\.5\.mAP_present must be float"),
        (lambda m: m.update(speeds=None), r"speeds must be dict"),
        (lambda m: m["speeds"]["25+"]["classes"].pop("car"), r"speeds\.25\+\.classes\.car is missing"),
        (lambda m: m["speeds"]["25+"]["classes"]["truck"].clear(), r"speeds\.25\+\.classes\.truck\.num_gt is missing"),
    ],
)
def test_a_number_that_is_none_is_named_with_its_file(tmp_path, write_run, change, message):
    folder = write_run("a", [], 0, 0.3, speeds=True)
    damage(folder / "metrics.json", change)
    with pytest.raises(DataError, match=rf"a/metrics\.json: {message}.*give the run's command again"):
        read_runs(tmp_path, "mini", ["phase1"])


def test_a_key_missing_in_the_record_is_named(tmp_path, write_run):
    folder = write_run("a", [], 0, 0.3)
    damage(folder / "run.json", lambda record: record["seconds"].clear())
    with pytest.raises(DataError, match=r"run\.json: seconds\.all is missing"):
        read_runs(tmp_path, "mini", ["phase1"])


def test_speeds_are_read_where_they_are(tmp_path, write_run):
    write_run("a", [], 0, 0.3)
    folder = write_run("b", [], 1, 0.4, speeds=True)
    damage(folder / "metrics.json", lambda m: m["speeds"]["25+"].update(mAP_present=None))  # nothing that fast
    damage(folder / "metrics.json", lambda m: m["speeds"]["10-25"]["classes"]["car"].update(AP=0, AVE=1, num_gt=0))
    old, new = read_runs(tmp_path, "mini", ["phase1"])
    assert not [key for key in old.metrics if key.startswith("speeds")]
    assert new.metrics["speeds.0-0.5.mAP_present"] == 0.4 and new.metrics["speeds.25+.mAP_present"] is None
    assert new.metrics["speeds.0-0.5.car.AP"] == 0.4 and new.metrics["speeds.0-0.5.car.AVE"] == 1.6
    assert new.metrics["speeds.10-25.car.AP"] is None and new.metrics["speeds.10-25.car.AVE"] is None
    assert new.metrics["speeds.10-25.boxes"] == 10 and new.metrics["speeds.0-0.5.car.boxes"] == 3
    assert new.metrics["ranges.0-25.mAP"] == new.metrics["classes.car.AP"] == 0.4


def test_phases_and_settings(tmp_path, write_run):
    write_run("a", ["seed=0", "phase=phase1", "scale=mini", "trainer.devices=2"], 0, 0.3)
    write_run("b", ["phase=phase2", "phase.train_missing=false", "phase.epochs=2"], 0, 0.4, phase="phase2")
    runs = read_runs(tmp_path, "mini", ["phase1", "phase2"])
    assert [(run.phase, run.settings) for run in runs] == [("phase1", ()), ("phase2", ("phase.epochs=2",))]
    assert [run.phase for run in read_runs(tmp_path, "mini", ["phase2"])] == ["phase2"]


def test_unfinished_and_replaced_runs_are_left_out(tmp_path, write_run):
    write_run("a", [], 0, 0.3)
    write_run("a.before-20260101-000000", [], 0, 0.9)
    (write_run("b", [], 1, 0.9) / "metrics.json").unlink()
    assert [run.metrics["mAP"] for run in read_runs(tmp_path, "mini", ["phase1"])] == [0.3]
