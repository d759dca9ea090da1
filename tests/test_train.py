"""What `python -m src.train` does with a run that exists, at debug scale."""

import json
import shutil
from pathlib import Path

import pytest
import torch

from src.config import compose_config
from src.errors import DataError
from src.models.backbones.resnet import Bottleneck, ResNet
from src.reliability.checkpoints import AtomicCheckpointIO, read_checkpoint
from src.sweep import sweep_files
from src.sweep.__main__ import main as run_sweep
from src.world.write import ensure_world
from tests.running import call

pytestmark = pytest.mark.slow

WORLD = ("data.world.lidar=true", "data.world.num_train_scenes=2", "data.world.num_val_scenes=1",
         "data.world.key_frames_per_scene=4")  # fmt: skip


@pytest.fixture(scope="module")
def worlds(tmp_path_factory):
    """Two data sets of the same splits."""
    folder = tmp_path_factory.mktemp("worlds")
    for seed, name in enumerate(("here", "there")):
        config, _ = compose_config(["scale=debug", *WORLD, f"data.world.seed={seed}"])
        ensure_world(config.data.world, folder / name, progress=False)
    return folder


def train(outputs, root, *overrides, expect=0):
    return call("train", "phase=phase1", "scale=debug", "model=centerpoint", "data.world=null", f"data.root={root}",
                "trainer.num_pictures=0", f"paths.outputs={outputs}", *overrides, expect=expect)  # fmt: skip


@pytest.fixture(scope="module")
def trained(worlds, tmp_path_factory):
    outputs = tmp_path_factory.mktemp("trained")
    train(outputs, worlds / "here")
    return outputs


@pytest.fixture
def outputs(trained, tmp_path):
    """A copy with one finished run."""
    return shutil.copytree(trained, tmp_path / "outputs")


def run_of(outputs) -> Path:
    (folder,) = outputs.glob("centerpoint-phase1-debug-????????")
    return folder


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.name != ".lock"}


def refused_on_other_data(outputs, worlds):
    folder = run_of(outputs)
    before = contents(folder)
    refused = train(outputs, worlds / "there", expect=4)
    for said in (f"{folder} was trained on", "'here'", f"data.root={worlds / 'there'} holds", "resume=restart"):
        assert said in refused.stderr
    assert "mAP" not in refused.stdout and contents(folder) == before


def test_a_finished_run_is_not_shown_for_other_data(outputs, worlds, tmp_path):
    refused_on_other_data(outputs, worlds)
    (tmp_path / "unmounted").mkdir()
    for root in (worlds / "here", tmp_path / "unmounted", tmp_path / "nowhere"):
        assert "mAP" in train(outputs, root).stdout
    first = json.loads((run_of(outputs) / "run.json").read_text())
    train(outputs, worlds / "there", "resume=restart")
    second = json.loads((run_of(outputs) / "run.json").read_text())
    assert second["samples_digest"] != first["samples_digest"] and second["data"]["root"] == "there"


def test_a_sweep_does_not_count_a_run_on_other_data(outputs, worlds, tmp_path, monkeypatch):
    sweep = """{title: One, question: "Which?", baseline: a, overrides: [phase=phase1, model=centerpoint],
      rows: [{label: a}],
      tables: [{name: one, title: One, columns: [mAP]}]}"""
    (tmp_path / "one.yaml").write_text(sweep)
    monkeypatch.setattr(sweep_files, "SWEEPS", tmp_path)
    command = ["+sweep=one", "scale=debug", "data.world=null", "trainer.num_pictures=0", "workers=0"]
    command += [f"paths.outputs={outputs}", f"paths.reports={tmp_path / 'reports'}"]
    run_sweep([*command, f"data.root={worlds / 'here'}"])
    with pytest.raises(DataError, match=f"{run_of(outputs)} was trained on.*there holds"):
        run_sweep([*command, f"data.root={worlds / 'there'}"])


def test_a_killed_run_does_not_resume_on_other_data(outputs, worlds, tmp_path):
    (run_of(outputs) / "run.json").unlink()
    refused_on_other_data(outputs, worlds)
    moved = shutil.copytree(worlds / "here", tmp_path / "moved")
    assert "resuming from" in train(outputs, moved).stderr


def test_a_recording_whose_only_sensor_saw_nothing_teaches_nothing(tmp_path):
    config, _ = compose_config(["scale=debug", *WORLD, "data.world.lidar=false"])  # its LiDAR key frames hold no point
    ensure_world(config.data.world, tmp_path / "dark", progress=False)
    said = train(tmp_path / "outputs", tmp_path / "dark", expect=DataError.exit_code).stderr
    assert "DataError: the loss of the whole epoch is 0" in said and "reads lidar" in said


def test_what_starts_from_a_checkpoint_needs_no_pretrained_file(worlds, tmp_path):
    """Neither a run that resumes nor the phase after it."""
    weights = tmp_path / "resnet50.pth"
    torch.save(ResNet(Bottleneck, [64, 128, 256, 512], [3, 4, 6, 3]).state_dict(), weights)
    command = ("train", "scale=debug", "model=dense_bev", "data.world=null", f"data.root={worlds / 'here'}",
               "backbone=resnet50", "backbone.image_size_px=[64,192]", f"backbone.weights={weights}",
               "trainer.num_pictures=0", f"paths.outputs={tmp_path}")  # fmt: skip
    call(*command, "phase=phase1")
    weights.unlink()
    (folder,) = tmp_path.glob("dense_bev-phase1-debug-????????")
    (folder / "run.json").unlink()
    assert "resuming from" in call(*command, "phase=phase1").stderr
    assert "weights from" in call(*command, "phase=phase2").stderr


def test_a_run_of_before_there_were_digests_goes_on(outputs, worlds):
    folder = run_of(outputs)
    record = json.loads((folder / "run.json").read_text())
    del record["samples_digest"]
    (folder / "run.json").write_text(json.dumps(record))
    assert "mAP" in train(outputs, worlds / "there").stdout
    last = folder / "checkpoints" / "last.ckpt"
    content = read_checkpoint(last)
    del content["DetectionDataModule"]
    AtomicCheckpointIO().save_checkpoint(content, last)
    (folder / "run.json").unlink()
    assert "resuming from" in train(outputs, worlds / "there").stderr
