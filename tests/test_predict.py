"""`python -m src.predict`: the boxes of `src.evaluate`, scene by scene, with pictures, whole files or none."""

import json

import numpy as np
import pytest
import torch
from PIL import Image

from src import evaluate, predict
from src.errors import CheckpointError, ConfigError, DataError
from src.streaming import StreamingDetector
from tests.running import command
from tests.untrained import write_checkpoint

FRAMES = 3  # of a scene


@pytest.fixture(scope="module")
def outputs(tmp_path_factory):
    return tmp_path_factory.mktemp("outputs")


@pytest.fixture(scope="module")
def checkpoints(outputs):
    """One per phase, in run folders, on a world of two validation scenes."""
    paths = {phase: outputs / f"run-{phase}" / "checkpoints" / "last.ckpt" for phase in ("phase1", "phase2")}
    for phase, path in paths.items():
        path.parent.mkdir(parents=True)
        write_checkpoint(path, f"phase={phase}", "data.world.num_val_scenes=2", f"paths.outputs={outputs}")
    return paths


def run(checkpoint, *overrides, pictures=0):
    predict.main([f"checkpoint={checkpoint}", f"trainer.num_pictures={pictures}", *overrides])


def results(folder):
    return json.loads((folder / "submission.json").read_text())["results"]


@pytest.fixture(scope="module")
def whole(checkpoints, outputs):
    """Phase 2 over the split, into the folder that the command chooses."""
    run(checkpoints["phase2"], f"paths.outputs={outputs}")
    return outputs / "predictions" / "run-phase2-last" / "val"


def by_place(box):
    return box["detection_name"], box["translation"]


@pytest.mark.slow
def test_an_evaluation_needs_the_checkpoint_alone(outputs, tmp_path):
    """The backbone's pretrained file, which training began from, need not be on this machine."""
    backbone = ("backbone=resnet50", "backbone.image_size_px=[64,192]", "backbone.weights=/nowhere/weights.pth")
    settings = ("phase=phase1", "data.world.num_val_scenes=2", f"paths.outputs={outputs}", *backbone)
    path = write_checkpoint(tmp_path / "a.ckpt", *settings)
    evaluate.main([f"checkpoint={path}", f"paths.outputs={outputs}", f"out={tmp_path}"])
    assert "mAP" in json.loads((tmp_path / "metrics.json").read_text())


@pytest.mark.slow
def test_a_model_trained_with_sensor_dropout_sees_whole_frames_unless_told_otherwise(whole, outputs, tmp_path):
    base = ("data.world.num_val_scenes=2", f"paths.outputs={outputs}")
    path = write_checkpoint(tmp_path / "a.ckpt", "phase=phase2", "data.sensor_dropout=0.9", *base)
    for name, told in (("plain", []), ("told", ["data.sensor_dropout=0.9"])):
        run(path, base[1], f"out={tmp_path / name}", *told)
    assert results(tmp_path / "plain") == results(whole) != results(tmp_path / "told")


@pytest.mark.slow
@pytest.mark.parametrize("phase", ["phase1", "phase2"])
def test_boxes_are_those_of_evaluate(checkpoints, outputs, tmp_path, phase):
    base = (f"paths.outputs={outputs}",)
    run(checkpoints[phase], *base, f"out={tmp_path / 'a'}")
    evaluate.main([f"checkpoint={checkpoints[phase]}", *base, f"out={tmp_path / 'b'}"])
    ours, theirs = results(tmp_path / "a"), results(tmp_path / "b")
    assert list(ours) == list(theirs) and len(ours) == 2 * FRAMES
    for token, boxes in ours.items():
        assert len(boxes) == len(theirs[token]) > 20
        # By place: scores of an untrained head may be a rounding apart, and batches of other sizes round differently.
        pairs = zip(sorted(boxes, key=by_place), sorted(theirs[token], key=by_place), strict=True)
        for mine, other in pairs:
            for name in ("translation", "size", "rotation", "velocity", "detection_score"):
                np.testing.assert_allclose(mine[name], other[name], atol=1e-4)
            assert all(mine[name] == other[name] for name in ("sample_token", "detection_name", "attribute_name"))


def scene_names(outputs):
    (world,) = (outputs / "worlds").iterdir()
    return json.loads((world / "splits.json").read_text())["val"]


@pytest.mark.slow
def test_one_scene_gives_its_samples_with_the_boxes_they_have_in_the_split(checkpoints, outputs, whole, capsys):
    first, second = scene_names(outputs)
    run(checkpoints["phase2"], f"paths.outputs={outputs}", f"scene={second}")
    printed = capsys.readouterr().out
    assert f"holds {second} only" in printed and f"all {2 * FRAMES} samples" in printed
    part, everything = results(whole.with_name(second)), results(whole)
    assert len(part) == FRAMES and all(everything[token] == boxes for token, boxes in part.items())


@pytest.mark.slow
def test_memory_shows_in_the_boxes_and_its_age_can_be_set(checkpoints, outputs, whole, tmp_path):
    run(checkpoints["phase2"], f"paths.outputs={outputs}", f"out={tmp_path}", "model.dptf.max_age_s=0.3")
    forgetful, everything = results(tmp_path), results(whole)
    changed = [forgetful[token] != boxes for token, boxes in everything.items()]
    assert sum(changed) == 2 * (FRAMES - 1)  # all but the first frame of each scene
    for folder, words in ((tmp_path, "memory of frames of up to 0.3 s"), (whole, "memory of frames of up to 6 s")):
        assert words in json.loads((folder / "submission.json").read_text())["meta"]["description"]


@pytest.mark.slow
def test_a_window_lets_nothing_older_through_what_is_remembered(checkpoints, outputs, whole, tmp_path):
    """0.8 s hold the frame before with its quarter second of sweeps; a stream's memory of it knows older frames too."""
    run(checkpoints["phase2"], f"paths.outputs={outputs}", f"out={tmp_path}", "data.past_window_s=0.8")
    windowed, everything = results(tmp_path), results(whole)
    same = [windowed[token] == boxes for token, boxes in everything.items()]
    assert same == 2 * ([True, True] + [False] * (FRAMES - 2))
    description = json.loads((tmp_path / "submission.json").read_text())["meta"]["description"]
    assert "memory of inputs of up to 0.8 s" in description
    scored, where = tmp_path / "scored", (f"checkpoint={checkpoints['phase2']}", f"paths.outputs={outputs}")
    evaluate.main([*where, f"out={scored}", "data.past_window_s=0.8"])
    counts = [{token: len(boxes) for token, boxes in results(folder).items()} for folder in (scored, tmp_path)]
    assert counts[0] == counts[1]
    with pytest.raises(ConfigError, match="each frame brings its past along"):
        evaluate.main([*where, "data.past_window_s=0.8", "oracle=velocity"])


@pytest.mark.slow
def test_pictures_of_the_first_scene(checkpoints, outputs, tmp_path, capsys):
    run(checkpoints["phase2"], f"paths.outputs={outputs}", f"out={tmp_path}", pictures=2)
    with Image.open(tmp_path / "scene.gif") as film, Image.open(tmp_path / "strip.png") as strip:
        assert film.n_frames == FRAMES and film.info["duration"] == 500 and film.info["loop"] == 0
        assert strip.size == (2 * film.width, film.height) and film.width < film.height < 2 * film.width
    assert {path.name for path in tmp_path.iterdir()} == {"submission.json", "scene.gif", "strip.png"}
    assert "submission.json, scene.gif, strip.png" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("command", [predict, evaluate])
def test_without_any_box_there_is_no_submission_not_even_an_older_one(
    checkpoints, outputs, tmp_path, caplog, capsys, command
):
    for name in ("submission.json", "strip.png"):
        (tmp_path / name).write_text("of an earlier command")
    none = (f"paths.outputs={outputs}", f"out={tmp_path}", "model.head.score_threshold=0.99", "trainer.num_pictures=0")
    command.main([f"checkpoint={checkpoints['phase1']}", *none])
    assert "no box reached the score threshold" in caplog.text and not (tmp_path / "submission.json").exists()
    assert (tmp_path / "strip.png").exists() == (command is evaluate)
    assert "submission.json" not in capsys.readouterr().out


@pytest.mark.slow
def test_results_under_other_settings_lie_elsewhere(checkpoints, outputs, tmp_path):
    (world,) = (outputs / "worlds").iterdir()
    for own in ("", "trainer.accelerator=cpu", "model.head.score_threshold=0.2", "model.head.score_threshold=0.3"):
        run(checkpoints["phase1"], f"paths.outputs={tmp_path}", f"data.root={world}", *filter(None, [own]))
    assert len(list((tmp_path / "predictions").iterdir())) == 3  # an accelerator changes no result


@pytest.mark.slow
def test_an_interrupted_run_leaves_what_was_there(checkpoints, outputs, tmp_path, monkeypatch):
    (tmp_path / "submission.json").write_text("older")
    steps, step = [], StreamingDetector.run

    def interrupted(self, frame):
        steps.append(frame)
        if len(steps) == 3:
            raise KeyboardInterrupt
        return step(self, frame)

    monkeypatch.setattr(StreamingDetector, "run", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(checkpoints["phase1"], f"paths.outputs={outputs}", f"out={tmp_path}")
    assert [path.name for path in tmp_path.iterdir()] == ["submission.json"]
    assert (tmp_path / "submission.json").read_text() == "older"


@pytest.mark.slow
def test_bad_input_is_named(checkpoints, outputs, tmp_path):
    good, base = checkpoints["phase1"], (f"paths.outputs={outputs}", f"out={tmp_path / 'out'}")
    with pytest.raises(ConfigError, match="give checkpoint=PATH"):
        predict.main([*base])
    with pytest.raises(ConfigError, match="give checkpoint=PATH"):
        run(good, *base, "predictions=a.json")
    with pytest.raises(ConfigError, match="oracle=motion: an option of python -m src.evaluate"):
        run(good, *base, "oracle=motion")
    with pytest.raises(CheckpointError, match="does not exist"):
        run(tmp_path / "none.ckpt", *base)
    with pytest.raises(CheckpointError, match="is a folder"):
        run(tmp_path, *base)
    for entry in (predict, evaluate):
        with pytest.raises(ConfigError, match="phase=phase2: the checkpoint is of phase=phase1"):
            entry.main([f"checkpoint={good}", base[0], f"out={tmp_path / 'never'}", "phase=phase2"])
    with pytest.raises(DataError, match="none.json: there is no such file"):
        evaluate.main([f"predictions={tmp_path / 'none.json'}", f"paths.outputs={tmp_path / 'new'}"])
    assert not (tmp_path / "new").exists()
    half = tmp_path / "half.ckpt"
    half.write_bytes(good.read_bytes()[:4000])
    with pytest.raises(CheckpointError, match="half.ckpt is truncated"):
        run(half, *base)
    foreign = tmp_path / "foreign.ckpt"
    torch.save({"state_dict": {"weight": torch.zeros(1)}}, foreign)
    with pytest.raises(CheckpointError, match="not of this project"):
        run(foreign, *base)
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="choose another out=FOLDER"):
        run(good, f"paths.outputs={outputs}", f"out={tmp_path / 'file' / 'out'}")
    name = scene_names(outputs)[0]
    with pytest.raises(ConfigError, match=f"no such scene.*nearest.*{name}"):
        run(good, *base, f"scene={name[:-1]}")
    with pytest.raises(DataError, match="split 'mini_val'"):
        run(good, *base, "data.split=mini_val")
    with pytest.raises(DataError, match="nowhere"):
        run(good, *base, f"data.root={tmp_path / 'nowhere'}")
    (world,) = (outputs / "worlds").iterdir()
    with pytest.raises(ConfigError, match="no such scene"):
        run(good, f"paths.outputs={tmp_path / 'new'}", f"data.root={world}", "scene=../../../../elsewhere")
    assert not (tmp_path / "out").exists() and not (tmp_path / "elsewhere").exists()


@pytest.mark.slow
def test_the_command_itself(checkpoints, outputs, tmp_path):
    base = (f"checkpoint={checkpoints['phase2']}", f"paths.outputs={outputs}", f"out={tmp_path}")
    ended = command("predict", *base, "trainer.num_pictures=0")
    assert f"{2 * FRAMES} frames" in ended.stdout and str(tmp_path) in ended.stdout
    assert "predicting" in ended.stderr and len(results(tmp_path)) == 2 * FRAMES
    refused = command("predict", *base, "scene=nothing", expect=3)
    assert "no such scene" in refused.stderr and "Traceback" not in refused.stderr
