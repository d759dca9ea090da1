"""Other detectors without LiDAR by the commands people type, at debug scale: phases, evaluation, streaming."""

import json
from itertools import islice

import pytest
import torch

from src.assembly import build_datamodule
from src.config import restore_config
from src.reliability.checkpoints import read_checkpoint
from src.streaming import StreamingDetector
from tests.running import call

pytestmark = pytest.mark.slow
FEW = "model.head.score_threshold=0.005"  # one step leaves every score near where it began


ALIKE = [pytest.param(name, marks=pytest.mark.exhaustive) for name in ("hydra", "far3d", "rctrans")]
"""Detectors whose memory and head one of the others has as well."""


@pytest.fixture(scope="module", params=["dense_bev", "crt_fusion", "sparc", "petr", *ALIKE])
def family(request):
    return request.param


@pytest.fixture(scope="module")
def outputs(tmp_path_factory, family):
    return tmp_path_factory.mktemp(family)


@pytest.fixture(scope="module")
def trained(outputs, family):
    """A run of phase 2, which trains its phase 1 first."""
    call("train", "phase=phase2", f"model={family}", "scale=debug", FEW, f"paths.outputs={outputs}")
    (folder,) = outputs.glob(f"{family}-phase2-debug-*")
    return folder


def test_both_phases_leave_what_is_promised(trained, outputs, family):
    (first,) = outputs.glob(f"{family}-phase1-debug-*")
    for folder in (first, trained):
        names = ("config.yaml", "metrics.json", "metrics.csv", "run.json", "submission.json", "checkpoints/last.ckpt")
        assert all((folder / name).is_file() for name in names), folder
        header = (folder / "metrics.csv").read_text().splitlines()[0].split(",")
        learnt = {"petr": {"loss/class"}, "far3d": {"loss/keypoint", "loss/depth"}, "rctrans": {"loss/class"}}
        learnt = learnt.get(family, {"loss/heatmap", "loss/depth"})
        assert {*learnt, "loss/box", "loss/total", "state/objects"} <= set(header)
        assert list((folder / "pictures").glob("frame_*.png"))
    assert "state/remembered_frames" in header
    log = (trained / "log.txt").read_text()
    assert "weights from" in log and "in temporal" in log
    meta = json.loads((trained / "submission.json").read_text())["meta"]
    assert meta["use_camera"] and meta["use_radar"] == (family not in ("petr", "far3d"))
    assert "memory of frames of up to 6 s" in meta["description"]
    weights = [read_checkpoint(folder / "checkpoints" / "last.ckpt")["state_dict"] for folder in (first, trained)]
    assert {key for key in weights[1] if key not in weights[0]} == {key for key in weights[1] if ".temporal." in key}


def test_evaluation_agrees_with_training(trained, outputs, tmp_path):
    checkpoint = f"checkpoint={trained / 'checkpoints' / 'last.ckpt'}"
    call("evaluate", checkpoint, f"out={tmp_path}", f"paths.outputs={outputs}")
    assert (tmp_path / "metrics.json").read_text() == (trained / "metrics.json").read_text()


def test_frames_are_streamed_as_the_validation_does(trained, outputs):
    """One at a time with the memory in the detector: what a batch of the model with that memory gives."""
    path = trained / "checkpoints" / "last.ckpt"
    detector = StreamingDetector.load(path)
    (world,) = (outputs / "worlds").iterdir()
    config = restore_config(read_checkpoint(path)["horizon3d"]["config"], [])
    frames = list(build_datamodule(config, world).stream())[:3]
    memory, seen = None, []
    for frame in frames:
        boxes = detector.step(frame)
        with torch.inference_mode():
            output, memory = detector.model(frame, None if bool(frame.starts[0]) else memory)
            (wanted,) = detector.model.decode(output)
        assert len(boxes) == len(wanted) and torch.allclose(boxes.centers, wanted.centers, atol=1e-4)
        seen.append(float(detector.model.diagnostics(output)["remembered_frames"]))
    assert seen == [0.0, 1.0, 2.0]  # the debug memory holds two frames
    detector.reset()
    assert detector.memory is None


def test_radargnn_which_has_no_memory_by_the_same_commands(tmp_path):
    outputs, scores = tmp_path / "outputs", tmp_path / "scores"
    call(
        "train",
        "phase=phase1",
        "model=radargnn",
        "scale=debug",
        FEW,
        f"paths.outputs={outputs}",
    )
    (folder,) = outputs.glob("radargnn-phase1-debug-*")
    path = folder / "checkpoints" / "last.ckpt"
    call("evaluate", f"checkpoint={path}", f"out={scores}", f"paths.outputs={outputs}")
    assert (scores / "metrics.json").read_text() == (folder / "metrics.json").read_text()
    meta = json.loads((folder / "submission.json").read_text())["meta"]
    assert meta["use_radar"] and not meta["use_camera"]
    detector = StreamingDetector.load(path)
    (world,) = (outputs / "worlds").iterdir()
    frames = build_datamodule(restore_config(read_checkpoint(path)["horizon3d"]["config"], []), world).stream()
    first = list(islice(frames, 2))
    assert len(first) == 2
    for frame in first:
        boxes = detector.step(frame)
        with torch.inference_mode():
            output, _ = detector.model(frame)
            (wanted,) = detector.model.decode(output)
        assert len(boxes) == len(wanted) and torch.allclose(boxes.centers, wanted.centers, atol=1e-4)
