"""suite=latency: the parts of a frame add up, and frames count once the memory is full."""

import itertools
import json
import os
import types

import pytest
import torch

from src.benchmark import suite_latency as latency
from src.benchmark.__main__ import main, report_latency
from src.benchmark.cases import CELLS_PER_VEHICLE, OCCUPIED_CELLS
from src.benchmark.page import number
from src.benchmark.scenes import ROADS
from src.benchmark.suite_latency import benchmark_latency
from src.errors import CheckpointError, ConfigError
from src.report.metric_names import METRICS
from tests.untrained import write_checkpoint


@pytest.fixture(scope="module")
def outputs(tmp_path_factory):
    return tmp_path_factory.mktemp("outputs")


ALL_PARTS = {"image_encoder", "radar_encoder", "kggi", "ocsf", "gaussian_encoder", "detection_head", "total"}


def latency_of(outputs, folder, monkeypatch, *own):
    monkeypatch.setattr(latency, "MEASURED_FRAMES", 4)
    path = write_checkpoint(folder / "some.ckpt", f"paths.outputs={outputs}", "trainer=cpu", *own)
    main(["suite=latency", f"checkpoint={path}", f"out={folder}", f"paths.outputs={outputs}", "trainer=cpu"])
    return json.loads((folder / "latency.json").read_text())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("own", "parts"),
    [
        (["phase=phase2"], ALL_PARTS | {"dptf"}),
        (["phase=phase1"], ALL_PARTS),
        (["phase=phase1", "model.kggi=null", "model.ocsf=null"], {"radar_encoder", "detection_head", "total"}),
        (["phase=phase1", "model=centerpoint", "data.world.lidar=true"], {"lidar_encoder", "detection_head", "total"}),
        (["phase=phase1", "model=radargnn"], {"radar_encoder", "detection_head", "total"}),
    ],
    ids=["with memory", "single frames", "radar only", "LiDAR only", "radar graph"],
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
    assert 1e-3 < result["gflop"] < 1e3
    assert (result["format"], result["frames"], result["device"]) == (1, 4, "cpu")
    assert result["threads"] == torch.get_num_threads() and result["precision"] == "32-true"
    assert result["processor"] and result["commit"] and result["load"] >= 0 and result["cores"] == os.cpu_count()
    printed = capsys.readouterr().out
    assert f"| total | {number(total)} |" in printed and "latency.json" in printed
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
        self.model.latency_parts = {}
        self.seen, self.remembered = [], 0

    def run(self, frame):
        self.remembered = 0 if frame.number == 0 else min(self.remembered + 1, self.depth)
        self.seen.append(self.remembered)


@pytest.mark.slow
@pytest.mark.parametrize(("lengths", "depth", "wanted"), [((6, 6), 3, 3), ((3, 2), 8, 2), ((4,), 0, 0), ((1,), 2, 0)])
def test_frames_count_once_the_memory_is_as_full_as_it_gets(monkeypatch, lengths, depth, wanted):
    """Which frames are measured is seen by a clock that each frame pushes on by what is remembered."""
    data, detector = FakeData(lengths), FakeDetector(depth)
    monkeypatch.setattr(latency, "split_samples", lambda index, split: None)
    monkeypatch.setattr(latency, "scenes_of", lambda index, samples: [range(length) for length in lengths])
    ticks = {"now": 0.0}

    def run(frame, run=detector.run):
        run(frame)
        ticks["now"] += 1.0 + detector.remembered

    detector.run = run
    monkeypatch.setattr(latency, "clock", lambda device: lambda: ticks["now"])
    result = benchmark_latency(detector, data, depth)
    assert result["frames"] == 20 and result["ms"]["total"] == pytest.approx(1e3 * (1 + wanted))
    assert result["spread_ms"]["total"] == 0.0
    assert len(detector.seen) >= 25  # the first ones warm up


@pytest.mark.slow
@pytest.mark.parametrize(("load", "warned"), [(1.9, False), (2.1, True)])
def test_a_busy_machine_is_warned_of(tmp_path, monkeypatch, capsys, load, warned):
    monkeypatch.setattr(latency, "read_checkpoint", lambda path: {"horizon3d": {"config": None}})
    model = types.SimpleNamespace(memory_frames=0)
    trainer = types.SimpleNamespace(device=lambda: torch.device("cpu"))
    config = types.SimpleNamespace(model=model, precision="32-true", trainer=trainer)
    monkeypatch.setattr(latency, "restore_config", lambda config_, overrides: config)
    monkeypatch.setattr(latency.StreamingDetector, "restore", lambda *_: FakeDetector(0))
    monkeypatch.setattr(latency, "data_root", lambda config, write: None)
    monkeypatch.setattr(latency, "build_datamodule", lambda config, root: FakeData((6, 6)))
    monkeypatch.setattr(latency, "split_samples", lambda index, split: None)
    monkeypatch.setattr(latency, "scenes_of", lambda index, samples: [range(6), range(6)])
    monkeypatch.setattr(latency, "busy_cores", lambda: load)
    monkeypatch.setattr("os.cpu_count", lambda: 4)
    report_latency(types.SimpleNamespace(checkpoint="x", out=str(tmp_path)), [])
    content = json.loads((tmp_path / "latency.json").read_text())
    assert (content["load"], content["cores"]) == (load, 4)
    assert (f"warning: {load} of 4 cores" in capsys.readouterr().out) == warned


@pytest.mark.slow
def test_without_a_checkpoint_fresh_weights_are_as_busy_as_trained_ones(outputs, tmp_path, monkeypatch):
    monkeypatch.setattr(latency, "MEASURED_FRAMES", 2)
    seen = []

    def measured(detector, datamodule, memory_frames):
        for frame in itertools.islice(datamodule.stream(), 2):
            output = detector.run(frame)[1]
            seen.append(len(output.ocsf.splat.cells.occupied))
            kept = [len(remembered.cells.rows) for remembered in detector.memory.frames]
        assert max(kept) == ROADS["debug"].num_vehicles * CELLS_PER_VEHICLE["debug"]
        return benchmark_latency(detector, datamodule, memory_frames)

    monkeypatch.setattr(latency, "benchmark_latency", measured)
    words = ["suite=latency", "scale=debug", "phase=phase2", "trainer=cpu", f"paths.outputs={outputs}"]
    main([*words, f"out={tmp_path}"])
    assert json.loads((tmp_path / "latency.json").read_text())["trained"] is False
    assert all(0.5 * OCCUPIED_CELLS["debug"] < cells <= 1.3 * OCCUPIED_CELLS["debug"] for cells in seen)


def test_what_cannot_be_timed_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="phase=lrs_forecast learns none"):
        main(["suite=latency", "model=lrs4fusion", "phase=lrs_forecast", f"out={tmp_path}"])
    with pytest.raises(CheckpointError, match="does not exist"):
        main(["suite=latency", f"checkpoint={tmp_path / 'no.ckpt'}", f"out={tmp_path}"])
    assert not list(tmp_path.iterdir())
