import json

import pytest

from src.errors import DataError
from src.reporting.results import read_runs
from src.reporting.tables import RANGES, experiment_tables

CLASSES = ("car", "truck")


def write_run(outputs, name, overrides, seed, value, root="world", scale="mini"):
    folder = outputs / f"horizon3d-phase1-{scale}-{name}"
    folder.mkdir(parents=True)
    record = {
        "run_id": folder.name, "overrides": overrides, "scale": scale, "seed": seed, "parameters": 2_500_000,
        "data": {"name": "synthetic highway", "root": root}, "seconds": {"all": 12.0},
        "peak_memory_mib": {"process": 900},
    }  # fmt: skip
    metrics = {
        "mAP": value, "NDS": value, "classes": {c: {"AP": value} for c in CLASSES},
        "ranges": {r: {"mAP": value} for r in RANGES},
    }  # fmt: skip
    (folder / "run.json").write_text(json.dumps(record))
    (folder / "metrics.json").write_text(json.dumps(metrics))
    return folder


def test_seeds_are_averaged_and_the_best_is_bold(tmp_path):
    for seed, value in enumerate((0.3, 0.4, 0.5)):
        write_run(tmp_path, f"a{seed}", [f"seed={seed}", "phase=phase1"], seed, value)
    write_run(tmp_path, "b", ["model.kggi=null", "model.ocsf=null", "paths.outputs=x", "data.root=y"], 0, 0.1)
    write_run(tmp_path, "c", [], 0, 0.9, scale="debug")
    runs = read_runs(tmp_path, "mini", "phase1")
    lines = experiment_tables(runs, {(): "ours", ("model.kggi=null", "model.ocsf=null"): "radar only"}).splitlines()
    assert lines[0].startswith("| experiment | mAP | NDS | car AP | mAP 0-25 m")
    assert lines[2].startswith("| ours | **40.0 ± 10.0** |")
    assert lines[3].startswith("| radar only | 10.0 |")
    assert any(line.startswith("| ours | 0, 1, 2 | 2.50 M | 12 | 900 |") for line in lines)


def test_different_data_never_share_a_table(tmp_path):
    write_run(tmp_path, "a", [], 0, 0.3)
    write_run(tmp_path, "b", [], 1, 0.3, root="other")
    with pytest.raises(ValueError, match="never mixes data"):
        experiment_tables(read_runs(tmp_path, "mini", "phase1"), {})


@pytest.mark.parametrize("content", ["", "[]", '{"scale": "mini", "run_id": "x-phase1-y"}'])
def test_broken_records_are_named(tmp_path, content):
    folder = write_run(tmp_path, "a", [], 0, 0.3)
    (folder / "run.json").write_text(content)
    with pytest.raises(DataError, match=r"run\.json"):
        read_runs(tmp_path, "mini", "phase1")


def test_a_number_edited_into_text_is_named(tmp_path):
    folder = write_run(tmp_path, "a", [], 0, 0.3)
    metrics = json.loads((folder / "metrics.json").read_text())
    metrics["classes"]["car"]["AP"] = "0.3"
    (folder / "metrics.json").write_text(json.dumps(metrics))
    with pytest.raises(DataError, match=r"metrics\.json.*classes\.car\.AP"):
        read_runs(tmp_path, "mini", "phase1")


def test_unfinished_and_replaced_runs_are_left_out(tmp_path):
    write_run(tmp_path, "a", [], 0, 0.3)
    write_run(tmp_path, "a.before-20260101-000000", [], 0, 0.9)
    (write_run(tmp_path, "b", [], 1, 0.9) / "metrics.json").unlink()
    assert [run.metrics["mAP"] for run in read_runs(tmp_path, "mini", "phase1")] == [0.3]
