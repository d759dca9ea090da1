"""LRS4Fusion's three phases as commands at debug scale: no labels in the first two, strict handoff, kill and resume."""

import json
import os
import shutil

import pytest
import torch
from PIL import Image

from tests.data.tiny_set import VERSION, write_data_set
from tests.running import call, killed_training
from tests.untrained import write_checkpoint

pytestmark = pytest.mark.slow
MODEL = ("model=lrs4fusion", "scale=debug", "trainer.num_pictures=0")


@pytest.fixture(scope="module")
def outputs(tmp_path_factory):
    return tmp_path_factory.mktemp("outputs")


@pytest.fixture(scope="module")
def occupancy(outputs):
    """The run of the first phase, which also wrote its world."""
    call("train", *MODEL, "phase=lrs_occupancy", f"paths.outputs={outputs}")
    return only(outputs, "lrs_occupancy")


@pytest.fixture(scope="module")
def world(occupancy, outputs):
    (root,) = (outputs / "worlds").iterdir()
    return root


def only(outputs, phase):
    (folder,) = outputs.glob(f"lrs4fusion-{phase}-debug-*")
    return folder


def weights(folder):
    return torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]


def record(folder):
    return json.loads((folder / "run.json").read_text())


@pytest.fixture(scope="module")
def unlabelled(world, tmp_path_factory):
    """The same world as recorded data that nobody has labelled."""
    root = tmp_path_factory.mktemp("unlabelled") / "world"
    labels = ("sample_annotation", "instance")
    shutil.copytree(
        world, root, ignore=shutil.ignore_patterns(*(f"{name}.json" for name in labels)), copy_function=os.link
    )
    return root


def test_the_first_phase_writes_its_world_and_scores_occupancy(occupancy, world):
    assert list(world.glob("s*s/LIDAR_LEFT")) and (world / "truth").is_dir()
    found, run = json.loads((occupancy / "metrics.json").read_text()), record(occupancy)
    assert (run["task"], run["headline"], run["initialized_from"]) == ("occupancy", "iou", None)
    assert 0 < found["iou"] <= 1 and {"iou@0.0s", "iou@0.4s", "slice_iou@0.4s", "velocity_error_moving"} <= set(found)
    assert not (occupancy / "submission.json").exists()


@pytest.mark.exhaustive
def test_without_labels_a_forecast_learns_the_ray_head_alone(unlabelled, tmp_path):
    places = ("trainer.num_pictures=1", "data.world=null", f"data.root={unlabelled}", f"paths.outputs={tmp_path}")
    said = call("train", *MODEL, "phase=lrs_forecast", *places)  # the first phase before it
    first, folder = only(tmp_path, "lrs_occupancy"), only(tmp_path, "lrs_forecast")
    assert record(folder)["initialized_from"] == first.name and "static 1s" in said.stdout
    before, after = weights(first), weights(folder)
    assert before.keys() <= after.keys() and all(torch.equal(before[name], after[name]) for name in before)
    assert {name.split(".")[1] for name in after.keys() - before.keys()} == {"ray_head"}
    found = json.loads((folder / "metrics.json").read_text())
    assert found["cd_1s"] > 0 and found["static_cd_1s"] > 0 and found["static_l1_median_1s"] > 0
    assert found["cd_gain_1s"] == pytest.approx(1 - found["cd_1s"] / found["static_cd_1s"])
    pictures = {path.name.partition("_")[0]: path for path in (folder / "pictures").glob("*.png")}
    assert set(pictures) == {"curves.png", "horizons.png", "occupancy", "forecast", "film"}
    assert Image.open(pictures["film"]).n_frames == 2  # the moments of 0.4 s
    checkpoint = folder / "checkpoints" / "last.ckpt"
    call("evaluate", f"checkpoint={checkpoint}", f"out={tmp_path / 'again'}", f"paths.outputs={tmp_path}")
    assert json.loads((tmp_path / "again" / "metrics.json").read_text()) == found
    failed = call("train", *MODEL, "phase=lrs_detection", *places, expect=4)
    assert "sample_annotation" in failed.stderr


def test_detection_begins_from_the_volume_with_a_new_head(occupancy, outputs):
    said = call("train", *MODEL, "phase=lrs_detection", f"paths.outputs={outputs}")
    folder = only(outputs, "lrs_detection")
    assert record(folder)["initialized_from"] == occupancy.name
    found = json.loads((folder / "metrics.json").read_text())
    assert "mAP" in found and "new:" in said.stderr and "long range (m)" in said.stdout
    assert list(found["long_range"]["ranges"]) == ["0-50", "50-150", "150-250"]
    before, after = weights(occupancy), weights(folder)
    assert {name.split(".")[1] for name in after.keys() - before.keys()} == {"neck", "head"}
    frozen = [name for name in before if ".decoders." in name]
    assert frozen and all(torch.equal(before[name], after[name]) for name in frozen)
    assert not torch.equal(before["model.pointnet.linear.weight"], after["model.pointnet.linear.weight"])


def test_pages_show_every_phase_with_its_command(occupancy, outputs, tmp_path):
    """The default model does not have these phases."""
    call("report.__main__", *MODEL[:2], "phase=lrs_detection", f"paths.outputs={outputs}", f"paths.reports={tmp_path}")
    for phase, page, words in (
        ("lrs_detection", "lrs_detection", "mAP, %"),
        ("lrs_occupancy", "lrs_occupancy_occupancy", "IoU above the ground at 0 s, %"),
    ):
        text = (tmp_path / f"{page}_debug.md").read_text()
        assert f"python -m src.train phase={phase} scale=debug model=lrs4fusion" in text and words in text
    assert "Scores over time and distance" in (tmp_path / "dashboard.html").read_text()


def test_two_processes_learn_from_rays_and_score_every_frame_once(occupancy, outputs, tmp_path):
    """A sample a rank; the learning rate is so small that both runs score the same weights."""
    still = ("phase=lrs_occupancy", "optim.lr=1e-12", f"data.root={next((outputs / 'worlds').iterdir())}")
    found = []
    for processes in (1, 2):
        folder = tmp_path / str(processes)
        call("train", *MODEL, *still, "trainer=cpu", f"trainer.devices={processes}", f"paths.outputs={folder}")
        run = only(folder, "lrs_occupancy")
        found.append(json.loads((run / "metrics.json").read_text()))
        assert record(run)["processes"] == processes and record(run)["steps"] > 0
    one, two = found
    assert one.keys() == two.keys() and one["intervals"]["scenes"] == two["intervals"]["scenes"]
    assert two["slice_iou@0.0s"] == pytest.approx(one["slice_iou@0.0s"], abs=0.02)
    assert two["velocity_error_moving"] == pytest.approx(one["velocity_error_moving"], rel=1e-3)


def test_what_learns_no_boxes_predicts_none(occupancy, outputs):
    said = call(
        "predict", f"checkpoint={occupancy / 'checkpoints' / 'last.ckpt'}", f"paths.outputs={outputs}", expect=3
    )
    assert "lrs_occupancy of lrs4fusion learns no boxes" in said.stderr


def test_a_source_of_another_region_is_refused(occupancy, outputs):
    checkpoint = occupancy / "checkpoints" / "last.ckpt"
    arguments = ("phase=lrs_forecast", f'phase.init_from="{checkpoint}"', f"paths.outputs={outputs}")
    said = call("train", *MODEL, *arguments, "model.unet.point_channels=16", expect=3)
    assert "unet" in said.stderr


@pytest.mark.parametrize(
    "phase",
    [
        "lrs_occupancy",
        *(pytest.param(f"lrs_{name}", marks=pytest.mark.exhaustive) for name in ("forecast", "detection")),
    ],
)
def test_a_killed_run_ends_with_the_same_weights(phase, occupancy, world, unlabelled, tmp_path):
    """What learns without labels has none."""
    source = "null" if phase == "lrs_occupancy" else occupancy / "checkpoints" / "last.ckpt"
    arguments = (*MODEL, f"phase={phase}", f"phase.init_from={source}", "phase.epochs=3", "data.batch_size=1")
    arguments += ("data.world=null", f"data.root={world if phase == 'lrs_detection' else unlabelled}")
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    call("train", *arguments, f"paths.outputs={whole}")
    killed_training(killed, *arguments)
    call("train", *arguments, f"paths.outputs={killed}")
    first, second = (only(outputs, phase) for outputs in (whole, killed))
    wanted, found = weights(first), weights(second)
    assert wanted.keys() == found.keys() and all(torch.equal(wanted[name], found[name]) for name in wanted)
    assert (first / "metrics.json").read_text() == (second / "metrics.json").read_text()
    assert record(second)["resumed"] and not record(first)["resumed"]


def test_a_world_without_lidar_names_the_model_that_needs_it(world, tmp_path):
    bare = tmp_path / "bare"
    shutil.copytree(world, bare, ignore=shutil.ignore_patterns("LIDAR*", "CAMERA*", "RADAR*"))
    (tables,) = {path.parent for path in bare.glob("*/sample_data.json")}
    files = json.loads((tables / "sample_data.json").read_text())
    (tables / "sample_data.json").write_text(json.dumps([row for row in files if "LIDAR" not in row["filename"]]))
    arguments = (f"data.root={bare}", f"paths.outputs={tmp_path}")
    said = call("train", *MODEL, "phase=lrs_occupancy", *arguments, expect=4)
    assert "model=lrs4fusion reads lidar" in said.stderr


def test_frames_with_a_past_of_the_timeline_have_no_stream_to_predict_or_to_correct(tmp_path):
    write_data_set(tmp_path / "data", lidar=True)
    own = ("phase=lrs_detection", "data.past_frames=2", "data.world=null", f"data.root={tmp_path / 'data'}")
    checkpoint = write_checkpoint(tmp_path / "own.ckpt", "model=lrs4fusion", *own, f"data.version={VERSION}")
    base = (f"checkpoint={checkpoint}", f"paths.outputs={tmp_path / 'outputs'}")
    said = call("predict", *base, expect=3).stderr
    assert "data.past_frames=2: must be 0 to follow scenes frame by frame" in said
    assert "oracle=motion: moves the memory of streams" in call("evaluate", *base, "oracle=motion", expect=3).stderr


def test_any_submission_is_scored_by_the_long_range_protocol(tmp_path):
    """On data without the LiDAR that the model with this protocol would read."""
    write_data_set(tmp_path / "data")
    tables = tmp_path / "data" / VERSION
    samples = [row["token"] for row in json.loads((tables / "sample.json").read_text())][:3]  # of the scene `train`
    annotation = next(
        row for row in json.loads((tables / "sample_annotation.json").read_text()) if row["sample_token"] == samples[0]
    )
    box = {"detection_name": "car", "detection_score": 0.5, "attribute_name": "vehicle.moving", "velocity": [14.0, 9.0]}
    box |= {name: annotation[name] for name in ("sample_token", "translation", "size", "rotation")}
    results = dict.fromkeys(samples, []) | {samples[0]: [box]}
    (tmp_path / "boxes.json").write_text(json.dumps({"meta": {}, "results": results}))
    data = ("data.world=null", f"data.root={tmp_path / 'data'}", f"data.version={VERSION}", "data.split=train")
    own = (f"predictions={tmp_path / 'boxes.json'}", *MODEL, "phase=lrs_detection", f"out={tmp_path / 'out'}")
    call("evaluate", *own, *data, f"paths.outputs={tmp_path / 'outputs'}")
    found = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert found["long_range"]["ranges"]["0-50"]["classes"]["car"]["AP"] > 0
