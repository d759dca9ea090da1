"""`python -m src.benchmark suite=model|latency`: every part of a step or a frame is measured, with a full memory."""

import json
import os
import types

import pytest
import torch
from untrained import write_checkpoint

from src import benchmark
from src.benchmark import benchmark_latency, main, timed_parts
from src.errors import CheckpointError, ConfigError
from src.reporting.metric_names import METRICS


@pytest.fixture(scope="module")
def outputs(tmp_path_factory):
    return tmp_path_factory.mktemp("outputs")


def measured(outputs, tmp_path, *own):
    main(["suite=model", "scale=debug", f"paths.outputs={outputs}", f"out={tmp_path}", "trainer=cpu", *own])
    return json.loads((tmp_path / "model_debug.json").read_text())["result"]


def test_the_memory_is_full_and_measured(outputs, tmp_path):
    result = measured(outputs, tmp_path, "phase=phase2", "model.dptf.bev_path.memory_threshold=0")
    parts = ("radar_encoder", "image_encoder", "kggi", "ocsf", "head")
    wanted = [f"{part} forward" for part in parts] + [f"dptf {part}" for part in ("recall", "aggregate", "remember")]
    assert set(wanted) <= set(result["seconds"])
    assert result["state"]["remembered_cells"] > 1000 and result["state"]["gaussians_history"] == 16  # 2 frames of 8
    assert "| dptf aggregate |" in (tmp_path / "model_debug.md").read_text()


def test_a_model_of_single_frames_has_no_memory_to_measure(outputs, tmp_path):
    result = measured(outputs, tmp_path, "phase=phase1")
    assert not [name for name in result["seconds"] if name.startswith("dptf")] and result["seconds"]["kggi forward"] > 0


# ---------------------------------------------------------------- latency

ALL_PARTS = {"image_encoder", "radar_encoder", "kggi", "ocsf", "gaussian_encoder", "detection_head", "total"}


def latency_of(outputs, folder, monkeypatch, *own):
    monkeypatch.setattr(benchmark, "MEASURED_FRAMES", 4)
    path = write_checkpoint(folder / "some.ckpt", f"paths.outputs={outputs}", "trainer=cpu", *own)
    main(["suite=latency", f"checkpoint={path}", f"out={folder}", f"paths.outputs={outputs}", "trainer=cpu"])
    return json.loads((folder / "latency.json").read_text())


@pytest.mark.parametrize(
    ("own", "parts"),
    [
        (["phase=phase2"], ALL_PARTS | {"dptf"}),
        (["phase=phase1"], ALL_PARTS),
        (["phase=phase1", "model.kggi=null", "model.ocsf=null"], {"radar_encoder", "detection_head", "total"}),
    ],
    ids=["with memory", "single frames", "radar only"],
)
def test_latency_of_the_parts_makes_up_that_of_a_frame(outputs, tmp_path, monkeypatch, capsys, own, parts):
    result = latency_of(outputs, tmp_path, monkeypatch, *own)
    milliseconds = result["ms"]
    assert set(milliseconds) == set(result["spread_ms"]) == parts
    assert {f"latency.{part}" for part in parts} <= METRICS.keys()
    total, encoder = milliseconds.pop("total"), milliseconds.pop("gaussian_encoder", 0.0)
    assert all(0 < value < total for value in milliseconds.values()) and encoder <= milliseconds.get("ocsf", 0.0)
    assert 0.5 * total < sum(milliseconds.values()) < 1.25 * total  # medians of each; what is between parts is little
    assert result["fps"] == pytest.approx(1e3 / total) and 0.1 < result["memory_gb"] < 64
    assert (result["format"], result["frames"], result["device"]) == (1, 4, "cpu")
    assert result["threads"] == torch.get_num_threads() and result["precision"] == "32-true"
    assert result["processor"] and result["commit"] and result["load"] >= 0 and result["cores"] == os.cpu_count()
    printed = capsys.readouterr().out
    assert f"| total | {total:.1f} |" in printed and "latency.json" in printed
    assert {path.name for path in tmp_path.iterdir()} == {"some.ckpt", "latency.json"}


class FakeData:
    """Validation scenes of these lengths."""

    def __init__(self, lengths):
        self.lengths, self.index, self.config = lengths, None, types.SimpleNamespace(split="val")

    def stream(self):
        return (FakeFrame(number) for length in self.lengths for number in range(length))


class FakeFrame:
    def __init__(self, number):
        self.number, self.starts = number, [number == 0]

    def to(self, device):
        return self


class FakeDetector:
    """Notes how many frames it remembers when a frame comes."""

    def __init__(self, depth):
        self.device, self.model, self.depth = torch.device("cpu"), torch.nn.Module(), depth
        self.seen, self.remembered = [], 0

    def run(self, frame):
        self.remembered = 0 if frame.number == 0 else min(self.remembered + 1, self.depth)
        self.seen.append(self.remembered)


@pytest.mark.parametrize(("lengths", "depth", "wanted"), [((6, 6), 3, 3), ((3, 2), 8, 2), ((4,), 0, 0), ((1,), 2, 0)])
def test_frames_count_once_the_memory_is_as_full_as_it_gets(monkeypatch, lengths, depth, wanted):
    """Which frames are measured is seen by a clock that each frame pushes on by what is remembered."""
    data, detector = FakeData(lengths), FakeDetector(depth)
    monkeypatch.setattr(benchmark, "split_samples", lambda index, split: None)
    monkeypatch.setattr(benchmark, "scenes_of", lambda index, samples: [range(length) for length in lengths])
    ticks = {"now": 0.0}

    def run(frame, run=detector.run):
        run(frame)
        ticks["now"] += 1.0 + detector.remembered

    detector.run = run
    monkeypatch.setattr(benchmark, "clock", lambda device: lambda: ticks["now"])
    result = benchmark_latency(detector, data, depth)
    assert result["frames"] == 20 and result["ms"]["total"] == pytest.approx(1e3 * (1 + wanted))
    assert result["spread_ms"]["total"] == 0.0
    assert len(detector.seen) >= 25  # the first ones warm up


@pytest.mark.parametrize(("load", "warned"), [(1.9, False), (2.1, True)])
def test_a_busy_machine_is_warned_of(tmp_path, monkeypatch, capsys, load, warned):
    monkeypatch.setattr(benchmark, "read_checkpoint", lambda path: {"horizon3d": {"config": None}})
    config = types.SimpleNamespace(model=types.SimpleNamespace(), precision="32-true", trainer=None)
    monkeypatch.setattr(benchmark, "restore_config", lambda config_, overrides: config)
    monkeypatch.setattr(benchmark, "chosen_device", lambda config: torch.device("cpu"))
    monkeypatch.setattr(benchmark.StreamingDetector, "restore", lambda *_: FakeDetector(0))
    monkeypatch.setattr(benchmark, "data_root", lambda config, write: None)
    monkeypatch.setattr(benchmark, "build_datamodule", lambda config, root: FakeData((6, 6)))
    monkeypatch.setattr(benchmark, "split_samples", lambda index, split: None)
    monkeypatch.setattr(benchmark, "scenes_of", lambda index, samples: [range(6), range(6)])
    monkeypatch.setattr("os.getloadavg", lambda: (load, 0.0, 0.0))
    monkeypatch.setattr("os.cpu_count", lambda: 4)
    benchmark.report_latency(types.SimpleNamespace(checkpoint="x", out=str(tmp_path)), [])
    content = json.loads((tmp_path / "latency.json").read_text())
    assert (content["load"], content["cores"]) == (load, 4)
    assert ("warning: the load was" in capsys.readouterr().out) == warned


def test_timed_parts_add_up_calls_and_leave_the_model_as_it_was():
    model = torch.nn.Module()
    model.first, model.second = torch.nn.Linear(2, 2), None
    before = dict(vars(model.first))
    timings = {}
    parts = {"both": ("first.forward", "first.extra_repr"), "absent": ("second.forward", "third.forward")}
    with pytest.raises(ZeroDivisionError), timed_parts(model, parts, timings, torch.device("cpu")):
        model.first(torch.zeros(1, 2))
        model.first.extra_repr()
        1 / 0  # noqa: B018
    assert list(timings) == ["both"] and len(timings["both"]) == 2 and vars(model.first) == before


def test_latency_needs_a_checkpoint(tmp_path):
    with pytest.raises(ConfigError, match="checkpoint=PATH"):
        main(["suite=latency", f"out={tmp_path}"])
    with pytest.raises(CheckpointError, match="does not exist"):
        main(["suite=latency", f"checkpoint={tmp_path / 'no.ckpt'}", f"out={tmp_path}"])
    assert not list(tmp_path.iterdir())
