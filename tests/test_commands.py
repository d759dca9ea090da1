"""The commands as people type them, at debug scale."""

import csv
import json
import subprocess

import pytest

from tests.running import ROOT, call, command, killed_training

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def outputs(tmp_path_factory):
    return tmp_path_factory.mktemp("outputs")


@pytest.fixture(scope="module")
def trained(outputs):
    """One debug run, made by the command: (run folder, its output)."""
    result = command("train", "phase=phase1", "scale=debug", f"paths.outputs={outputs}")
    (folder,) = outputs.glob("horizon3d-phase1-debug-*")
    return folder, result


def test_train_leaves_everything_that_is_promised(trained):
    folder, result = trained
    for name in ("config.yaml", "metrics.json", "metrics.csv", "log.txt", "run.json", "submission.json"):
        assert (folder / name).is_file(), name
    assert {p.name for p in (folder / "checkpoints").iterdir()} == {"best.ckpt", "last.ckpt"}
    assert list((folder / "pictures").glob("frame_*.png"))
    metrics = json.loads((folder / "metrics.json").read_text())
    assert set(metrics) >= {"mAP", "NDS", "mATE", "mASE", "mAOE", "mAVE", "mAAE", "classes", "ranges", "tags"}
    assert set(metrics["ranges"]) == {"0-25", "25-50", "50-100", "100-150"} and len(metrics["classes"]) == 12
    for word in ("mAP", "NDS", "car", "100-150", str(folder)):
        assert word in result.stdout
    with (folder / "metrics.csv").open() as file:
        columns = next(csv.reader(file))
    kggi, ocsf = ("keypoint", "depth", "radar_objectness"), ("occupancy_focal", "occupancy_dice")
    for term in ("heatmap", "box", *kggi, *ocsf, "total"):
        assert f"loss/{term}" in columns, term


def test_the_same_command_shows_the_finished_run(trained, outputs):
    folder, first = trained
    before = {p: p.stat().st_mtime_ns for p in folder.rglob("*") if p.is_file() and p.name != ".lock"}
    again = call("train", "phase=phase1", "scale=debug", f"paths.outputs={outputs}")
    assert "mAP" in again.stdout
    assert before == {p: p.stat().st_mtime_ns for p in folder.rglob("*") if p.is_file() and p.name != ".lock"}
    call("train", "phase=phase1", "scale=debug", f"paths.outputs={outputs}", "resume=never", expect=3)


def test_evaluate_agrees_with_training_from_checkpoint_and_from_file(trained, outputs, tmp_path):
    folder, _ = trained
    expected = json.loads((folder / "metrics.json").read_text())
    checkpoint = folder / "checkpoints" / "last.ckpt"
    call("evaluate", f"checkpoint={checkpoint}", f"out={tmp_path / 'a'}", f"paths.outputs={outputs}")
    assert json.loads((tmp_path / "a" / "metrics.json").read_text()) == expected
    refused = call("evaluate", f"checkpoint={checkpoint}", f"out={folder}", f"paths.outputs={outputs}", expect=3)
    assert f"out={folder}: is the folder of a run" in refused.stderr
    (world,) = (outputs / "worlds").iterdir()
    call(
        "evaluate", f"predictions={tmp_path / 'a' / 'submission.json'}", f"data.root={world}",
        f"out={tmp_path / 'b'}", f"paths.outputs={outputs}",
    )  # fmt: skip
    submission = tmp_path / "a" / "submission.json"
    call("evaluate", f"predictions={submission}", f"data.root={world}", f"paths.outputs={outputs}")
    (own,) = (outputs / "evaluations").glob("a-submission-*/metrics.json")  # files of one name in others of that name
    assert own.read_text() == (tmp_path / "b" / "metrics.json").read_text()
    from_file = json.loads((tmp_path / "b" / "metrics.json").read_text())
    measures = from_file.pop("measures")  # a file of boxes does not tell what they were made of
    assert {name.partition("_")[0] for name in measures} == {"moving"}
    assert measures.items() <= expected.pop("measures").items()
    assert from_file == expected


def test_an_oracle_tells_a_memory_how_things_move(trained, outputs, tmp_path):
    from tests.untrained import write_checkpoint

    folder, _ = trained
    (world,) = (outputs / "worlds").iterdir()
    data = (f"data.root={world}", f"paths.outputs={outputs}")
    checkpoint = write_checkpoint(tmp_path / "memory.ckpt", "phase=phase2")
    found = set()
    for oracle in ("none", "velocity", "motion"):
        call("evaluate", f"checkpoint={checkpoint}", *data, f"out={tmp_path / oracle}", f"oracle={oracle}")
        found.add((tmp_path / oracle / "submission.json").read_text())
    assert len(found) == 3, "what is remembered lies elsewhere each time"
    still = [f"model.dptf.{path}_path.velocity_compensation=false" for path in ("bev", "gaussian")]
    unmoved = write_checkpoint(tmp_path / "unmoved.ckpt", "phase=phase2", *still)
    single, boxes = folder / "checkpoints" / "last.ckpt", tmp_path / "none" / "submission.json"
    told = ("oracle=velocity", *data, f"out={tmp_path / 'no'}")
    assert "moves nothing of its memory" in call("evaluate", f"checkpoint={unmoved}", *told, expect=3).stderr
    assert "of single frames" in call("evaluate", f"checkpoint={single}", *told, expect=3).stderr
    assert "no memory" in call("evaluate", f"predictions={boxes}", *told, expect=3).stderr
    assert "option of python -m src.evaluate" in call("train", *told[:1], "scale=debug", expect=3).stderr


def test_evaluate_refuses_what_it_cannot_score(trained, outputs, tmp_path):
    folder, _ = trained
    (world,) = (outputs / "worlds").iterdir()
    base = (f"data.root={world}", f"paths.outputs={outputs}", f"out={tmp_path}")
    assert "either checkpoint" in command("evaluate", *base, expect=3).stderr
    assert "does not exist" in call("evaluate", "checkpoint=nothing.ckpt", *base, expect=3).stderr
    half = tmp_path / "half.ckpt"
    half.write_bytes((folder / "checkpoints" / "last.ckpt").read_bytes()[:5000])
    assert "half.ckpt" in call("evaluate", f"checkpoint={half}", *base, expect=3).stderr
    wrong = tmp_path / "wrong.json"
    wrong.write_text('{"meta": {}, "results": {}}')
    assert "wrong.json" in call("evaluate", f"predictions={wrong}", *base, expect=4).stderr
    other = ("data=truckscenes", f"data.root={tmp_path / 'nowhere'}")
    assert "nowhere" in call("evaluate", f"predictions={wrong}", *other, f"out={tmp_path}", expect=4).stderr


def test_a_killed_run_resumes_and_ends_with_the_same_weights(trained, outputs, tmp_path):
    import torch

    changes = ("scale=debug", "phase.epochs=3", "trainer.num_pictures=0", "model.kggi=null", "model.ocsf=null")
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    (world,) = (outputs / "worlds").iterdir()
    arguments = (*changes, f"data.root={world}")
    call("train", *arguments, f"paths.outputs={whole}")
    killed_training(killed, *arguments)
    call("train", *arguments, f"paths.outputs={killed}")
    (a,) = whole.glob("horizon3d-*/checkpoints/last.ckpt")
    (b,) = killed.glob("horizon3d-*/checkpoints/last.ckpt")
    first, second = (torch.load(p, weights_only=True)["state_dict"] for p in (a, b))
    assert first.keys() == second.keys() and all(torch.equal(first[k], second[k]) for k in first)
    assert (a.parent.parent / "metrics.json").read_text() == (b.parent.parent / "metrics.json").read_text()
    lines = [(p.parent.parent / "metrics.csv").read_text().splitlines()[0] for p in (a, b)]
    assert lines[0] == lines[1]


def test_world_preview_and_comparison(outputs, tmp_path):
    paths = [f"paths.outputs={outputs}", f"out={tmp_path}"]
    result = call("world.__main__", "scale=debug", "preview=true", "compare=true", *paths)
    assert list(tmp_path.glob("scene_*.png")) and "picture:" in result.stdout
    assert "Boxes with at least one radar point: " in result.stdout
    page = (tmp_path / "statistics.md").read_text()
    assert "2 scenes of 3 key frames" in page and "compare=true" in page and str(outputs) not in page
    recorded = ("data=truckscenes", f"data.root={tmp_path}", "preview=true", "compare=true")
    assert "no world to write or to preview" in call("world.__main__", *recorded, *paths, expect=3).stderr


def test_make_names_its_targets_and_a_wrong_phase():
    helped = subprocess.run(["make", "help"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for target in ("install", "world", "train", "sweep", "study", "report", "benchmark", "test", "check"):
        assert f"make {target}" in helped
