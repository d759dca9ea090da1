"""suite=latency: milliseconds of a model's frame by part, in the streaming that prediction uses."""

from __future__ import annotations

import itertools
import os
from pathlib import Path
from typing import Any

import torch

from src.assembly import build_datamodule, data_root
from src.benchmark.cases import (
    OCCUPIED_CELLS,
    detector_case,
    expect_trained_occupancy,
    fill_memory,
    measured_detector,
    remembering,
)
from src.benchmark.counting import counted_work
from src.benchmark.machine import busy_cores, describe_machine, processor
from src.benchmark.page import page_of
from src.benchmark.timing import clock, forget_peak, median_iqr, peak_bytes, timed_parts
from src.config import Config, restore_config
from src.data.clips import scenes_of
from src.data.datamodule import DetectionDataModule
from src.data.reader import ReaderSettings
from src.data.splits import split_samples
from src.errors import ConfigError
from src.reliability.checkpoints import read_checkpoint
from src.streaming import StreamingDetector
from src.structures.batch import FrameBatch
from src.training.phases import EVALUATORS
from src.training.run_folder import current_commit

LATENCY_FORMAT = 1
WARM_UP_FRAMES = 5
MEASURED_FRAMES = 20


def measure_latency(command: Config, overrides: list[str]) -> dict[str, Any]:
    """What `latency.json` holds, see `benchmark_latency`: of a checkpoint's own model on its own validation frames, or
    of the configured one with fresh weights, see `busy_detector`.

    Raises ConfigError for a phase that learns no boxes.
    """
    if command.checkpoint is not None:
        path = Path(command.checkpoint)
        checkpoint = read_checkpoint(path)
        config = restore_config(checkpoint["horizon3d"]["config"], overrides)
        detector = StreamingDetector.restore(config, checkpoint, path, config.trainer.device())
        datamodule = build_datamodule(config, data_root(config, write=False))
    else:
        config = command
        if not EVALUATORS[config.phase.task].labels:
            raise ConfigError(f"suite=latency times boxes, but phase={config.phase.name} learns none")
        datamodule = build_datamodule(config, data_root(config))
        detector = busy_detector(config, datamodule.settings, next(datamodule.stream()))
    result = benchmark_latency(detector, datamodule, config.model.memory_frames)
    known = {"trained": command.checkpoint is not None, "precision": config.precision, "commit": current_commit()}
    return {"format": LATENCY_FORMAT, **result, **known}


def busy_detector(config: Config, settings: ReaderSettings, frame: FrameBatch) -> StreamingDetector:
    """Fresh weights with as much to do as trained ones: candidates for boxes, cells that Gaussians occupy, cells that
    are remembered. What else a model computes hardly follows its weights."""
    detector = measured_detector(remembering(config), settings, frame)
    case = detector_case(detector, frame)
    fill_memory(case, config.model.memory_frames)
    expect_trained_occupancy(case, OCCUPIED_CELLS[config.scale])
    return detector


def latency_page(content: dict[str, Any], overrides: list[str]) -> dict[str, Any]:
    """The content of `latency.json` as a page."""
    rows = [{"part": part, "ms": value, "± ms": content["spread_ms"][part]} for part, value in content["ms"].items()]
    rest = {name: value for name, value in content.items() if name not in ("format", "ms", "spread_ms")}
    machine = describe_machine() | {"load": content["load"]}
    return page_of("latency", overrides, machine, {"a frame by part": rows} | rest)


def benchmark_latency(
    detector: StreamingDetector, datamodule: DetectionDataModule, memory_frames: int
) -> dict[str, Any]:
    """Median milliseconds of a frame and of its parts, from the frame on the device to its boxes; reading is not in it.

    The clocks of the parts run meanwhile, and on a GPU each of them waits for it.

    The spread is the interquartile range. Frames count once the memory is full, or as full as scenes are long.
    `load` is how many of the `cores` were at work when this began.
    `memory_gb` is the largest that torch held on a GPU, or the process with its libraries on a CPU, in 1e9 bytes, once
    warm.
    `gflop` are those of one more frame, as `counted_work` sees them.
    """
    device, now, load = detector.device, clock(detector.device), busy_cores()
    parts = detector.model.latency_parts
    scenes = scenes_of(datamodule.index, split_samples(datamodule.index, datamodule.config.split))
    full = min(memory_frames, max(map(len, scenes)) - 1)
    measured, number = [], 0  # the frame's place in its scene
    for seen, frame in enumerate(itertools.chain.from_iterable(datamodule.stream() for _ in itertools.count())):
        number = 0 if bool(frame.starts[0]) else number + 1
        frame, memory_is_full = frame.to(device), number >= full
        if len(measured) == MEASURED_FRAMES and memory_is_full:
            memory_gb = peak_bytes(device) / 1e9
            with counted_work() as work:
                detector.run(frame)
            break
        with timed_parts(detector.model, parts, now) as seconds:
            begin = now()
            detector.run(frame)
            whole = now() - begin
        if seen + 1 == WARM_UP_FRAMES:
            forget_peak(device)
        if seen >= WARM_UP_FRAMES and memory_is_full and len(measured) < MEASURED_FRAMES:
            measured.append({name: 1e3 * value for name, value in (seconds | {"total": whole}).items()})
    columns = {name: [row[name] for row in measured] for name in (*parts, "total") if name in measured[0]}
    medians = {name: median_iqr(values) for name, values in columns.items()}
    return {
        "ms": {name: middle for name, (middle, _) in medians.items()},
        "spread_ms": {name: iqr for name, (_, iqr) in medians.items()},
        "fps": 1e3 / medians["total"][0],
        "memory_gb": memory_gb,
        "gflop": work.flops / 1e9,
        "frames": len(measured),
        "device": str(device),
        "processor": torch.cuda.get_device_name() if device.type == "cuda" else processor(),
        "threads": torch.get_num_threads(),
        "load": round(load, 2),
        "cores": os.cpu_count() or 1,
    }
