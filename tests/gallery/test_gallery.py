"""`python -m src.gallery`: pages of real runs, and what it refuses."""

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from src.config import compose_config
from src.errors import DataError
from src.gallery.__main__ import Gallery, short_names
from src.metrics.submission import to_global
from src.structures.boxes import Boxes3D
from src.structures.detections import DetectionTable
from tests.evaluation_sets import set_of
from tests.running import call

SHEETS = ["gallery_conditions_debug.png", "gallery_false_positives_debug.png", "gallery_misses_debug.png"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """(outputs, the one run in it)."""
    outputs = tmp_path_factory.mktemp("outputs")
    call("train", "phase=phase1", "scale=debug", f"paths.outputs={outputs}", "trainer.num_pictures=0")
    (run,) = outputs.glob("horizon3d-phase1-debug-*")
    return outputs, run


def refused(outputs, *overrides, expect):
    return call("gallery.__main__", "scale=debug", f"paths.outputs={outputs}", *overrides, expect=expect).stderr


@pytest.mark.slow
def test_the_page_shows_its_pictures_and_its_command(trained, tmp_path):
    outputs, run = trained
    shutil.copytree(run, outputs / "another")
    names = f"runs={run.name},another"
    places = (f"paths.outputs={outputs}", f"paths.reports={tmp_path}")
    said = call("gallery.__main__", "scale=debug", names, *places).stdout
    page = tmp_path / "gallery_debug.md"
    assert f"written: {page}" in said
    text = page.read_text()
    assert f"python -m src.gallery scale=debug {names}`" in text and str(tmp_path) not in text
    assert "the run `another` finds, beside" in text
    assert sorted(path.name for path in (tmp_path / "pictures").glob("*.png")) == SHEETS
    assert all(f"(pictures/{name})" in text for name in [*SHEETS, "gallery_debug.gif"])
    with Image.open(tmp_path / "pictures" / "gallery_debug.gif") as film:
        assert film.n_frames == 3  # of a debug scene


def test_scenes_without_a_condition_are_refused_by_the_name_of_their_split(tmp_path):
    config, _ = compose_config(["scale=debug"])
    untagged = set_of(DetectionTable.empty(), tags=("area.city",))
    datamodule = SimpleNamespace(evaluation_set=lambda: untagged)
    with pytest.raises(DataError, match="data.split=val: none of its scenes has a tag of weather, daytime, lighting"):
        Gallery(config, datamodule, {"run": DetectionTable.empty()}).write(tmp_path, "python -m src.gallery")
    assert not list(tmp_path.iterdir())


def test_a_frame_that_lost_its_boxes_counts_returns_in_the_annotations():
    config, _ = compose_config(["scale=debug"])
    none, one = torch.zeros(1, 2), torch.zeros(1, dtype=torch.int64)
    box = Boxes3D(torch.tensor([[10.0, 0.0, 1.0]]), torch.full((1, 3), 2.0), torch.zeros(1), none, one, one)
    truth = to_global(box, np.eye(4), 1)
    frames = [
        SimpleNamespace(
            tokens=[token], boxes=[], lidar_points=None, lidar_batch=None, radar_batch=torch.tensor([0, 0]),
            radar_points=torch.tensor([[10.0, 0.0, 1.0], [30.0, 0.0, 1.0]]),
        )
        for token in ("a", "b")
    ]  # fmt: skip
    datamodule = SimpleNamespace(evaluation_set=lambda: set_of(truth, ("a", "b")), stream=lambda: frames)
    assert Gallery(config, datamodule, {})._count_returns().tolist() == [1]


def test_panels_are_named_by_what_tells_the_runs_apart():
    one, two, other = (f"{name}-mini-0123456{digit}" for digit, name in enumerate(["a-phase1", "a-phase1", "b-phase2"]))
    assert short_names([one, other, "mine"]) == ["a phase1", "b phase2", "mine"]
    assert short_names([one, two, other]) == [one, two, "b phase2"]


@pytest.mark.slow
def test_what_it_refuses(trained, tmp_path):
    outputs, run = trained
    assert "give runs=A,B" in refused(outputs, expect=3)
    assert "runs=nowhere: " in refused(outputs, "runs=nowhere", expect=3)
    other = shutil.copytree(run, outputs / "other")
    record = json.loads((other / "run.json").read_text())
    (other / "run.json").write_text(json.dumps(record | {"data": record["data"] | {"root": "0123"}}))
    assert "runs=other: it was scored on" in refused(outputs, "runs=other", expect=4)
    (other / "run.json").write_text(json.dumps(record | {"scale": "mini"}))
    said = refused(outputs, "runs=other", expect=3)
    assert "runs=other: it is of scale=mini, this command of scale=debug" in said
    (other / "run.json").write_text(json.dumps(record))
    (other / "submission.json").unlink()  # as a run without any box leaves none
    said = refused(outputs, "runs=other", f"paths.reports={tmp_path}", expect=3)
    assert "has no submission.json" in said and "leave it out" in said
    assert not list(tmp_path.glob("*.md"))
