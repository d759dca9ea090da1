"""Publishing finished runs and reading results; refusing what is not as it was written."""

import errno
import json
import os
import re
import shutil
from pathlib import Path

import pytest

from src.errors import DataError
from src.report import json_format
from src.report.results import (
    finished_runs,
    publish_latency,
    publish_result,
    read_result,
    read_results,
    read_results_or_raise,
    result_path,
)
from src.report.run_curves import MAX_POINTS


def damage(path, change):
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


@pytest.fixture
def reports(tmp_path):
    return tmp_path / "reports"


@pytest.fixture
def published(write_run, reports):
    """The result file of one run, scored by speed."""
    return publish_result(write_run("a", ["seed=3", "phase=phase1", "model.kggi=null"], 3, 0.3, speeds=True), reports)


def test_a_run_is_published_and_read(published, reports):
    assert published == reports / "results" / "horizon3d-phase1-mini-a.json"
    result = read_result(published)
    assert (result.run_id, result.model, result.phase, result.scale, result.seed) == (
        "horizon3d-phase1-mini-a", "horizon3d", "phase1", "mini", 3
    )  # fmt: skip
    assert result.settings == ("model.kggi=null",) and result.overrides == ["seed=3", "phase=phase1", "model.kggi=null"]
    assert result.dataset == "synthetic highway world" and result.data["split"] == "val"
    assert result.metrics["mAP"] == result.metrics["classes.car.AP"] == result.metrics["ranges.0-25.mAP"] == 0.3
    assert result.metrics["classes.truck.AVE"] == 1.7 and result.metrics["ranges.25-50.NDS"] == 0.3
    assert result.metrics["speeds.0-0.5.boxes"] == 13 and result.metrics["speeds.0-0.5.car.boxes"] == 3
    assert result.curves == {"loss/total": [[4, 5.5], [9, 4.5]], "val/mAP": [[4, 0.1], [9, 0.2]]}
    assert result.config["model"]["ocsf"]["margin_m"] == 4.8 and result.latency is None
    assert "tags" not in json.loads(published.read_text())["metrics"]
    assert read_results(reports, "mini") == ({result.run_id: result}, {}) and read_results(reports, "debug") == ({}, {})


def test_the_second_score_of_detections_is_read_by_name(write_run, reports):
    folder = write_run("a", [], 0, 0.3)
    metrics = json.loads((folder / "metrics.json").read_text())
    own = {name: metrics[name] for name in ("mAP", "NDS", "mAVE", "classes")}
    path = "long_range.ranges.150-250.mAP"
    (folder / "metrics.json").write_text(
        json.dumps(
            metrics
            | {"long_range": own | {"mAP": 0.6, "ranges": {"150-250": own | {"mAP": 0.1}}}}
            | {"intervals": {"scenes": 20, "draws": 500, "level": 0.95, "bounds": {path: [0.0, 0.2]}}}
        )
    )
    result = read_result(publish_result(folder, reports))
    assert result.metrics["mAP"] == 0.3 and result.metrics["long_range.mAP"] == 0.6
    assert result.metrics[path] == 0.1 and result.intervals == {path: [0.0, 0.2]}


def with_intervals(folder, bounds):
    path = folder / "metrics.json"
    metrics = json.loads(path.read_text()) | {"measures": {"moving_AP": 0.4, "moving_boxes": 9, "history_near": None}}
    path.write_text(json.dumps(metrics | {"intervals": {"scenes": 20, "draws": 500, "level": 0.95, "bounds": bounds}}))
    return folder


def test_intervals_and_measures_are_read_by_name(write_run, reports):
    bounds = {"mAP": [0.2, 0.4], "measures.moving_AP": [0.3, 0.5], "speeds.25+.classes.car.AP": [0.1, 0.9],
              "ranges.0-25.mAP": [0.0, 1.0], "classes.car.ATE": [1.0, 2.0], "speeds.25+.classes.bus.AP": [0.0, 0.1],
              "speeds.25+.classes.bus.ATE": [1.0, 2.0], "tags.rain.mAP": [0.0, 0.1]}  # fmt: skip
    path = publish_result(with_intervals(write_run("a", [], 0, 0.3, speeds=True), bounds), reports)
    result = read_result(path)
    assert result.intervals == {"mAP": [0.2, 0.4], "measures.moving_AP": [0.3, 0.5], "speeds.25+.car.AP": [0.1, 0.9],
                                "speeds.25+.bus.AP": [0.0, 0.1], "ranges.0-25.mAP": [0.0, 1.0]}  # fmt: skip
    assert result.scenes == 20 and result.metrics["measures.moving_AP"] == 0.4
    assert result.metrics["measures.history_near"] is None
    assert "tags.rain.mAP" not in path.read_text() and "classes.car.ATE" not in path.read_text(), "nobody reads them"


def test_normalised_scores_by_speed_are_read_where_a_run_has_them(write_run, reports):
    older = read_result(publish_result(write_run("a", [], 0, 0.3, speeds=True), reports))
    assert "speeds.25+.mAP_normalized" not in older.metrics and "speeds.25+.bus.AP_normalized" not in older.metrics
    bounds = {"speeds.25+.mAP_normalized": [0.1, 0.3], "speeds.25+.classes.car.AP_normalized": [0.4, 0.6]}
    folder = with_intervals(write_run("b", [], 1, 0.3, speeds=True), bounds)
    metrics = json.loads((folder / "metrics.json").read_text())
    part = metrics["speeds"]["25+"]
    part["mAP_normalized"], part["classes"]["car"]["AP_normalized"] = 0.2, 0.5
    part["classes"]["bus"] = {"AP": 0.0, "AP_normalized": 0.0, "num_gt": 0}
    (folder / "metrics.json").write_text(json.dumps(metrics))
    result = read_result(publish_result(folder, reports))
    found = {name: value for name, value in result.metrics.items() if name.endswith("_normalized")}
    assert found == {
        "speeds.25+.mAP_normalized": 0.2, "speeds.25+.car.AP_normalized": 0.5, "speeds.25+.bus.AP_normalized": None
    }  # fmt: skip
    assert result.intervals == {"speeds.25+.mAP_normalized": [0.1, 0.3], "speeds.25+.car.AP_normalized": [0.4, 0.6]}


@pytest.mark.parametrize(
    ("bounds", "message"),
    [
        ({"mAP": [0.1]}, "bounds.mAP"),
        ({"mAP": 0.1}, "bounds.mAP"),
        ({"mAP": [0.1, "0.2"]}, "bounds.mAP"),
        ([0.1], "intervals.bounds"),
    ],
)
def test_bounds_that_are_none_are_named(write_run, reports, bounds, message):
    with pytest.raises(DataError, match=rf"metrics.json: intervals.*{message}|metrics.json: {message}"):
        publish_result(with_intervals(write_run("a", [], 0, 0.3), bounds), reports)


def test_publishing_again_changes_nothing_until_the_run_does(write_run, reports):
    folder = write_run("a", [], 0, 0.3)
    path = publish_result(folder, reports)
    before = path.stat().st_mtime_ns, path.stat().st_ino
    assert publish_result(folder, reports) == path and (path.stat().st_mtime_ns, path.stat().st_ino) == before
    latency = {"format": 1, "ms": {"image_encoder": 7.5, "total": 117.7}, "spread_ms": {}, "fps": 8.5, "memory_gb": 3.2,
               "frames": 20, "device": "cpu", "processor": "x", "threads": 1}  # fmt: skip
    (folder / "latency.json").write_text(json.dumps(latency))
    publish_result(folder, reports)
    result = read_result(path)
    assert result.latency == latency and result.metrics["latency.image_encoder"] == 7.5
    assert result.metrics["latency.fps"] == 8.5 and "latency.dptf" not in result.metrics
    path.write_text("{")  # damaged since
    publish_result(folder, reports)
    assert read_result(path) == result
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_a_latency_of_fresh_weights_stays_with_its_result(write_run, reports, tmp_path):
    """It was measured elsewhere; one of the run's own weights is what its folder says, or none."""
    folder, other = write_run("a", [], 0, 0.3), tmp_path / "latency"
    other.mkdir()
    for trained in (False, True):
        latency = {"ms": {"total": 117.7}, "fps": 8.5, "memory_gb": 3.2, "trained": trained}
        (other / "latency.json").write_text(json.dumps(latency))
        path = publish_latency(other, reports, read_result(publish_result(folder, reports)).run_id)
        assert read_result(path).latency == latency
        assert (read_result(publish_result(folder, reports)).latency is None) == trained


def test_a_digest_of_the_samples_makes_no_other_result(write_run, reports):
    folder = write_run("a", [], 0, 0.3)
    before = publish_result(folder, reports).read_bytes()
    damage(folder / "run.json", lambda record: record.update(samples_digest="0123456789abcdef"))
    assert publish_result(folder, reports).read_bytes() == before


def test_no_path_of_the_machine_is_published(write_run, reports, tmp_path):
    machine = [
        f"paths.outputs={tmp_path}", "paths.reports=/r", "phase.train_missing=false",
        "trainer.devices=2", "trainer=cpu", "logger=wandb",
        "resume=never", "data.num_workers=4", f"data.root={tmp_path}", "++data.root=/d",
    ]  # fmt: skip
    places = [f"phase.init_from={tmp_path}/x/last.ckpt", "backbone.weights='~/r50.pth'", "++model.file=../here/y"]
    result = read_result(publish_result(write_run("a", [*machine, *places, "model=horizon3d"], 0, 0.3), reports))
    text = result_path(reports, result.run_id).read_text()
    assert str(tmp_path) not in text and "/x/" not in text and "here" not in text
    names = [re.sub("@[0-9a-f]{8}$", "@", override) for override in result.overrides]
    assert names == ["phase.init_from=last.ckpt@", "backbone.weights=r50.pth@", "++model.file=y@", "model=horizon3d"]
    assert result.config["backbone"]["file"].startswith("r50.pth@")
    assert not {"paths", "out"} & result.config.keys() and "root" not in result.config["data"]
    other = read_result(publish_result(write_run("b", ["phase.init_from=/elsewhere/last.ckpt"], 0, 0.3), reports))
    assert other.settings[0] != result.settings[-1]  # two files of one name are two experiments


def test_long_curves_are_thinned_evenly(write_run, reports):
    folder = write_run("a", [], 0, 0.3)
    lines = [f"{step},{step / 10},nan" for step in range(1001)]
    (folder / "metrics.csv").write_text("\n".join(["step,loss/total,loss/box", *lines, "1001,,1.0"]))
    curves = read_result(publish_result(folder, reports)).curves
    assert len(curves["loss/total"]) == MAX_POINTS and curves["loss/total"][0] == [0, 0.0]
    assert curves["loss/total"][-1] == [1000, 100.0] and curves["loss/box"] == [[1001, 1.0]]


def test_speeds_are_read_where_they_are(write_run, reports, publish_all):
    write_run("a", [], 0, 0.3)
    folder = write_run("b", [], 1, 0.4, speeds=True)
    damage(folder / "metrics.json", lambda m: m["speeds"]["25+"].update(mAP_present=None))  # nothing that fast
    damage(folder / "metrics.json", lambda m: m["speeds"]["10-25"]["classes"]["car"].update(AP=0, AVE=1, num_gt=0))
    damage(folder / "metrics.json", lambda m: m["speeds"]["25+"]["classes"]["truck"].pop("AP"))  # as older runs have it
    damage(folder / "metrics.json", lambda m: m["speeds"]["0-0.5"]["classes"]["truck"].update(AP=0.1, num_gt=0))
    damage(folder / "metrics.json", lambda m: m["speeds"]["25+"]["classes"]["car"].update(AP=0.02, AVE=1.0))  # missed
    publish_all()
    old, new = read_results(reports)[0].values()
    assert not [key for key in old.metrics if key.startswith("speeds")]
    assert new.metrics["speeds.0-0.5.mAP_present"] == 0.4 and new.metrics["speeds.25+.mAP_present"] is None
    assert new.metrics["speeds.0-0.5.car.AP"] == 0.4 and new.metrics["speeds.0-0.5.car.AVE"] == 1.6
    assert new.metrics["speeds.10-25.car.AP"] is None and new.metrics["speeds.10-25.car.AVE"] is None
    assert new.metrics["speeds.25+.car.AP"] == 0.02 and new.metrics["speeds.25+.car.AVE"] is None
    assert new.metrics["speeds.0-0.5.truck.AP"] is None and "speeds.25+.truck.AP" not in new.metrics
    assert new.metrics["speeds.10-25.truck.AP"] == 0.4 and "speeds.10-25.truck.AVE" not in new.metrics
    assert new.metrics["speeds.10-25.boxes"] == 10 and new.metrics["speeds.0-0.5.car.boxes"] == 3


@pytest.mark.parametrize("content", ["", "[]", '{"scale": "mini", "run_id": "x-phase1-y"}'])
def test_broken_records_of_runs_are_named(write_run, reports, content):
    folder = write_run("a", [], 0, 0.3)
    (folder / "run.json").write_text(content)
    with pytest.raises(DataError, match=r"run\.json"):
        publish_result(folder, reports)
    assert not reports.exists()


SCORES = [
    (lambda m: m.update(mAP=1.5), r"mAP must be less than or equal to 1\.0+1, but is 1\.5"),
    (lambda m: m.update(NDS=-0.1), "NDS must be greater than or equal to 0, but is -0.1"),
    (lambda m: m["classes"]["car"].update(AP=30), r"classes\.car\.AP must be less than or equal to 1\.0"),
    (lambda m: m["speeds"]["25+"].update(mAP_present=2.0), r"speeds\.25\+\.mAP_present must be less than or equal"),
    (lambda m: m.update(mAVE=-2e6), r"mAVE must be greater than or equal to -1000000, but is -2000000\.0"),
    (lambda m: m.update(mAVE=int("9" * 400)), r"mAVE must be a finite number, but is 9+"),
    (lambda m: m["classes"]["truck"].update(AVE=1e308), r"classes\.truck\.AVE must be less than or equal to 1000000"),
    (lambda m: m["classes"]["car"].update(AP="0.3"), r"classes\.car\.AP must be a valid number, but is '0\.3'"),
    (lambda m: m["ranges"]["0-25"].clear(), r"ranges\.0-25\.mAP is missing"),
    (lambda m: m["ranges"]["0-25"].update(classes=None), r"ranges\.0-25\.classes must be an object"),
    (lambda m: m.update(ranges=[]), r"ranges must be an object"),
    (lambda m: m.update(mAP=None), r"mAP must be a valid number, but is None"),
    (lambda m: m.update(mAP=float("nan")), r"mAP must be a finite number, but is nan"),
    (lambda m: m["ranges"]["25-50"].update(NDS=float("inf")), r"ranges\.25-50\.NDS must be a finite number"),
    (lambda m: m["speeds"]["25+"].pop("mAVE_present"), r"speeds\.25\+\.mAVE_present is missing"),
    (lambda m: m["speeds"]["0-0.5"].update(mAP_present=True), r"speeds\.0-0\.5\.mAP_present must be a valid number"),
    (lambda m: m.update(speeds=None), r"speeds must be an object"),
    (lambda m: m["speeds"]["25+"]["classes"].pop("car"), r"speeds\.25\+\.classes\.car is missing"),
    (lambda m: m["speeds"]["25+"]["classes"]["truck"].clear(), r"speeds\.25\+\.classes\.truck\.num_gt is missing"),
]


@pytest.mark.parametrize(("change", "message"), SCORES)
def test_a_number_that_is_none_is_named_with_its_run(write_run, reports, change, message):
    folder = write_run("a", [], 0, 0.3, speeds=True)
    damage(folder / "metrics.json", change)
    with pytest.raises(DataError, match=rf"a/metrics\.json: {message}.*give the run's command again"):
        publish_result(folder, reports)


@pytest.mark.parametrize(("change", "message"), SCORES)
def test_and_with_its_result(published, change, message):
    damage(published, lambda content: change(content["metrics"]))
    with pytest.raises(DataError, match=rf"mini-a\.json: metrics\.{message}.*delete it and run python -m src\.report"):
        read_result(published)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.pop("format"), "format is missing"),
        (lambda c: c.update(format=0), "format must be greater than or equal to 1, but is 0"),
        (lambda c: c.update(format=True), "format must be a valid integer, but is True"),
        (lambda c: c.pop("commit"), "commit is missing"),
        (lambda c: c.update(seed="0"), "seed must be a valid integer, but is '0'"),
        (lambda c: c.update(overrides=[1]), r"overrides\.0 must be a valid string, but is 1"),
        (lambda c: c["data"].pop("root"), r"data\.root is missing"),
        (lambda c: c["seconds"].update(all="12"), r"seconds\.all must be a valid number, but is '12'"),
        (lambda c: c["peak_memory_mib"].clear(), r"peak_memory_mib\.process is missing"),
        (
            lambda c: c.update(curves={"loss/total": [[1, "2"]]}),
            r"curves\.loss/total\.0\.1 must be a valid number, but is '2'",
        ),
        (lambda c: c["curves"]["val/mAP"].append([1, float("nan")]), r"curves\.val/mAP\.2\.1 must be a finite number"),
        (
            lambda c: c.update(latency={"ms": {"total": "7"}, "fps": 1.0, "memory_gb": 1.0}),
            r"latency\.ms\.total must be",
        ),
        (lambda c: c.update(latency={"ms": {}, "memory_gb": 1.0}), r"latency\.fps is missing"),
        (lambda c: c.update(latency=7), "latency must be an object, but is 7"),
        (lambda c: c.update(model=None), "model must be a valid string"),
        (lambda c: c.update(run_id="horizon3d-phase1-mini-b"), "run_id must be horizon3d-phase1-mini-a, the file"),
        (lambda c: c.update(parameters=int("9" * 400)), r"parameters must be less than or equal to 1000000000000000"),
        (
            lambda c: c.update(latency={"ms": {}, "fps": 1.0, "memory_gb": 1.0, "spread_ms": {"total": "x"}}),
            r"latency\.spread_ms\.total must be a valid number",
        ),
    ],
)
def test_a_result_that_is_not_one_is_named(published, change, message):
    damage(published, change)
    with pytest.raises(
        DataError, match=rf"mini-a\.json: {message}.*; restore it .* or delete it and run python -m src\.report"
    ):
        read_result(published)


def test_truncated_and_foreign_files_are_named_and_the_rest_is_read(published, write_run, reports):
    publish_result(write_run("b", [], 0, 0.4), reports)
    published.write_bytes(published.read_bytes()[:2000])
    (published.parent / "horizon3d-phase1-mini-list.json").write_text("[]")
    (published.parent / "horizon3d-phase1-mini-bytes.json").write_bytes(b"\xff\xfe")
    results, broken = read_results(reports, "mini")
    assert list(results) == ["horizon3d-phase1-mini-b"]
    assert {path.name.split("-")[-1]: str(error).removeprefix(f"{path}: ")[:20] for path, error in broken.items()} == {
        "a.json": "not readable as JSON", "bytes.json": "not readable as JSON", "list.json": "the file must be an "
    }  # fmt: skip


def test_what_cannot_be_read_is_an_error_to_those_who_want_it(published, write_run, reports):
    other = publish_result(write_run("b", [], 0, 0.4), reports)
    published.write_text("{")
    assert list(read_results_or_raise(reports, "mini", [other.stem])) == [other.stem]
    for wanted in (None, [published.stem]):
        with pytest.raises(DataError, match=r"mini-a\.json: not readable.*restore it"):
            read_results_or_raise(reports, "mini", wanted)


def test_an_older_run_that_was_resumed_says_nothing_of_its_time(published):
    assert read_result(published).metrics["cost.training"] == 12.0
    damage(published, lambda content: content.update(resumed=True))
    assert read_result(published).metrics["cost.training"] is None
    damage(published, lambda content: content["seconds"].update(earlier=5.0))
    assert read_result(published).metrics["cost.training"] == 12.0


@pytest.mark.parametrize("depth", [100_000, 940])  # the second is read, but hardly walked through
def test_deep_json_is_named(published, reports, depth):
    content = published.read_text()
    published.write_text(content.replace('"data": ', f'"data": {"[" * depth}{"]" * depth}, "x": ', 1))
    with pytest.raises(DataError, match=r"mini-a\.json: .*delete it and run python -m src\.report"):
        read_result(published)
    assert read_results(reports)[1].keys() == {published}


def test_a_file_beyond_every_real_one_is_not_parsed(published, monkeypatch):
    monkeypatch.setattr(json_format, "MAX_BYTES", 100)
    with pytest.raises(DataError, match=r"mini-a\.json: .*at most 100 bytes are expected, but it has \d+"):
        read_result(published)


def test_millions_of_wrong_values_are_counted_and_not_listed(published):
    damage(published, lambda c: c.update(versions=dict.fromkeys(map(str, range(10_000)), 0)))
    with pytest.raises(DataError, match=r"mini-a\.json: 10000 values are wrong; restore it .* or delete it"):
        read_result(published)
    damage(published, lambda c: c.update(versions={}, overrides=[0] * 10_000))
    with pytest.raises(DataError, match=r"mini-a\.json: overrides\.0 must be a valid string"):
        read_result(published)


def test_a_share_of_all_may_be_a_rounding_above_one(published):
    damage(published, lambda c: c["metrics"].update(mAP=1.0000000000000002))
    assert read_result(published).metrics["mAP"] == 1.0000000000000002


def other_task(folder, **metrics):
    damage(folder / "run.json", lambda record: record.update(task="segmentation", headline="IoU"))
    (folder / "metrics.json").write_text(json.dumps(metrics))
    return folder


def test_a_run_of_another_task_has_the_numbers_it_has(write_run, reports):
    bounds = {"scenes": 3, "bounds": {"IoU": [0.5, 1.5], "of_another_name": [0.0, 1.0]}, "level": 0.95}
    numbers = {"IoU": 1, "recall": 0.25, "lanes": None, "classes": {"car": float("nan")}, "intervals": bounds}
    folder = other_task(write_run("a", [], 0, 0.3), **numbers)
    path = publish_result(folder, reports)
    result = read_result(path)
    assert (result.task, result.headline) == ("segmentation", "IoU")
    cost = {"cost.parameters": 2_500_000, "cost.training": 12.0}
    assert result.metrics == {"IoU": 1.0, "recall": 0.25, "lanes": None} | cost
    assert result.intervals["IoU"] == [0.5, 1.5] and result.scenes == 3
    damage(path, lambda content: content.update(task="detection"))
    with pytest.raises(DataError, match="metrics.mAP is missing"):
        read_result(path)
    damage(path, lambda content: content.update(task="../x"))
    with pytest.raises(DataError, match="task String should match pattern"):
        read_result(path)


@pytest.mark.parametrize(
    ("metrics", "message"),
    [({"recall": 0.5}, "IoU, the headline number of its task, is missing"),
     ({"IoU": None}, "IoU, the headline number of its task, is missing"),
     ({"IoU": float("nan")}, "IoU.* must be a finite number"), ({"IoU": 0.5, "recall": "high"}, "recall.* must be a")],
)  # fmt: skip
def test_numbers_of_another_task_are_checked(write_run, reports, metrics, message):
    with pytest.raises(DataError, match=rf"a/metrics\.json: {message}"):
        publish_result(other_task(write_run("a", [], 0, 0.3), **metrics), reports)


def test_losses_too_large_to_draw_are_left_out(write_run, reports):
    folder = write_run("a", [], 0, 0.3)
    (folder / "metrics.csv").write_text("step,loss/total\n1,1e300\n2,5.0\n")
    assert read_result(publish_result(folder, reports)).curves == {"loss/total": [[2, 5.0]]}


def test_a_run_without_its_configuration_is_named(write_run, reports):
    folder = write_run("a", [], 0, 0.3)
    for content in ("model: {name: x}", "a: [", "- 1"):
        (folder / "config.yaml").write_text(content)
        with pytest.raises(DataError, match=r"a/config\.yaml: not a run's configuration"):
            publish_result(folder, reports)


def test_a_copy_of_a_folder_replaces_no_result(write_run, reports):
    folder = write_run("a", [], 0, 0.3)
    before = publish_result(folder, reports).read_bytes()
    copy = shutil.copytree(folder, folder.with_name(f"{folder.name}.copy"))
    damage(copy / "metrics.json", lambda m: m.update(mAP=0.9))
    with pytest.raises(DataError, match=rf"run_id must be {copy.name}, the folder's name, but is {folder.name}; move"):
        publish_result(copy, reports)
    assert [path.read_bytes() for path in (reports / "results").iterdir()] == [before]


def test_a_curve_that_is_no_number_is_named(write_run, reports):
    folder = write_run("a", [], 0, 0.3)
    (folder / "metrics.csv").write_text("step,loss/total\n1,x\n")
    with pytest.raises(DataError, match=r"a/metrics\.csv: not a run's learning curves"):
        publish_result(folder, reports)


def test_a_full_disk_leaves_the_older_result(write_run, reports, monkeypatch):
    folder = write_run("a", [], 0, 0.3)
    path = publish_result(folder, reports)
    before = path.read_text()
    damage(folder / "metrics.json", lambda m: m.update(mAP=0.9))

    def full(source: Path, target: Path) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OSError, match="No space left") as raised:
        publish_result(folder, reports)
    assert raised.value.filename == str(path) and raised.value.errno == errno.ENOSPC  # what command.py tells the user
    monkeypatch.undo()
    assert path.read_text() == before and [p.name for p in path.parent.iterdir()] == [path.name]


def test_unfinished_replaced_and_other_runs_are_left_out(tmp_path, write_run):
    finished = write_run("a", [], 0, 0.3)
    write_run("a.before-20260101-000000", [], 0, 0.9)
    write_run("c", [], 0, 0.9, scale="debug")
    (write_run("b", [], 1, 0.9) / "metrics.json").unlink()
    (tmp_path / "worlds").mkdir()
    assert list(finished_runs(tmp_path, "mini")) == [finished]


def test_settings_are_what_makes_an_experiment(make_result):
    overrides = ["seed=0", "phase=phase2", "scale=mini", "phase.epochs=2", "+model.a=1"]
    assert make_result("x", {}, overrides=overrides).settings == ("+model.a=1", "phase.epochs=2")


def test_five_hundred_results_are_read(published, reports):
    text = published.read_text()
    for number in range(499):
        path = published.with_name(f"horizon3d-phase1-mini-{number:08x}.json")
        path.write_text(text.replace("horizon3d-phase1-mini-a", path.stem))
    results, broken = read_results(reports, "mini")
    assert len(results) == 500 and not broken
