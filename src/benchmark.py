"""`python -m src.benchmark [suite=model|latency|metric|reader] [scale=...] [out=DIR]`: time and memory of the parts.

suite=model   one training step of the configured model, part by part, forward and forward + backward; the weights are
              random unless checkpoint=PATH (of the same configuration) is given. With phase=phase2 the memory is full,
              but an untrained model holds no cell worth remembering: model.dptf.bev_path.memory_threshold=0 keeps all
suite=latency a frame of the trained model checkpoint=PATH, part by part, with full memory in phase 2, over the frames
              that it was validated on; into DIR/latency.json, where DIR is the run's folder if tables are to show it
suite=metric  our metric against the official evaluator on one val-sized problem
suite=reader  frames per second of the reader on one core
"""

from __future__ import annotations

import os
import platform
import resource
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from src.assembly import build_datamodule, build_model, data_root
from src.command import run_command
from src.config import Accelerator, BenchmarkSuite, Config, compose_config, restore_config
from src.data.clips import scenes_of
from src.data.datamodule import DetectionDataModule
from src.data.splits import split_samples
from src.errors import ConfigError, DataError
from src.metrics.benchmark import compare_with_devkit
from src.models.detector import Detector
from src.ops.allocator import tune_cpu_allocator
from src.reporting.sweep_text import is_busy
from src.streaming import StreamingDetector
from src.structures.batch import FrameBatch
from src.training.checkpoints import load_model_weights, read_checkpoint
from src.training.processes import check_devices
from src.training.run_folder import current_commit, make_writable, write_json

REPEATS = 3
KEY_FRAME_S = 0.5
FRAMES_TO_REMEMBER = 8  # the longest memory, Table 10
PART_METHODS = ("forward", "recall", "aggregate", "remember")
"""What a detector calls its parts by; the memory is not a function of one input, so it has no forward."""
LATENCY_FORMAT = 1
WARM_UP_FRAMES = 5
MEASURED_FRAMES = 20
LATENCY_PARTS = {
    "image_encoder": ("image_encoder.forward",),
    "radar_encoder": ("radar_encoder.forward",),
    "kggi": ("kggi.forward",),
    "ocsf": ("ocsf.forward",),
    "gaussian_encoder": ("ocsf.encoder.forward",),  # within ocsf (Table 14)
    "dptf": ("dptf.recall", "dptf.aggregate", "dptf.remember"),
    "detection_head": ("head.forward", "head.decode"),
}
"""The parts of Table 15 by the methods of a model that they are; a part that a model lacks is left out."""
READER_FRAMES = 40
VAL_SIZED = {"num_samples": 3000, "gts": 25, "preds": 300}
"""About the size of the official val split with a full submission."""


def main(overrides: list[str]) -> None:
    """Measure one suite, print its table, and keep it as JSON and Markdown in `out` when given."""
    config, _ = compose_config(overrides)
    tune_cpu_allocator()
    if config.suite is BenchmarkSuite.latency:
        report_latency(config, overrides)
        return
    suites = {
        BenchmarkSuite.model: benchmark_model,
        BenchmarkSuite.metric: lambda config: compare_with_devkit(**VAL_SIZED, seed=config.seed),
        BenchmarkSuite.reader: benchmark_reader,
    }
    if config.out:
        make_writable(Path(config.out), "out")
    result = {"suite": config.suite.value, "overrides": overrides, "machine": machine()}
    result |= {"result": suites[config.suite](config)}
    text = markdown(result)
    print(text)
    if config.out:
        folder = Path(config.out)
        name = f"{config.suite.value}_{config.scale}" if config.suite is not BenchmarkSuite.metric else "metric"
        write_json(folder / f"{name}.json", result)
        (folder / f"{name}.md").write_text(text + "\n")
        print(f"written: {folder / name}.md and .json")
    if result["result"].get("agrees") is False:
        raise DataError("our metric and the official evaluator disagree on this problem; see the numbers above")


def benchmark_model(config: Config) -> dict[str, Any]:
    """Medians over REPEATS steps of one frame batch, seconds per part; peak memory of the process."""
    torch.manual_seed(config.seed)
    config.data.batch_size, config.data.num_workers = 1, 0
    datamodule = build_datamodule(config, data_root(config))
    batch = next(iter(datamodule.train_dataloader()))
    device = chosen_device(config)
    model = build_model(config)
    if config.checkpoint:
        load_model_weights(model, read_checkpoint(Path(config.checkpoint)), Path(config.checkpoint))
    model, batch = model.to(device).train(), batch.to(device)
    timings: dict[str, list[float]] = {}
    memory = None
    unmeasured = FRAMES_TO_REMEMBER if config.phase.temporal else 0
    for number in range(unmeasured + REPEATS):
        kept = timings if number >= unmeasured else {}
        terms, memory = timed_step(model, batch, memory, kept, device, config.precision == "bf16-mixed")
        batch = replace(batch, timestamps_s=batch.timestamps_s + KEY_FRAME_S)  # the truck stands, its memory fills
    return {
        "device": str(device),
        "seconds": {name: statistics.median(values) for name, values in timings.items()},
        "spread": {name: max(values) - min(values) for name, values in timings.items()},
        "losses": {name: float(value) for name, value in terms.items()},
        "peak_memory_mib": int(peak_bytes(device) / 2**20),
        "parameters": {name: sum(p.numel() for p in part.parameters()) for name, part in model.named_children()},
        "radar_points": len(batch.radar_points),
        "state": {name: float(value) for name, value in model.diagnostics(model(batch, memory)[0]).items()},
    }


def timed_step(
    model: Detector,
    batch: FrameBatch,
    memory: Any,  # the model's own, see `Detector.forward`
    timings: dict[str, list[float]],
    device: torch.device,
    autocast: bool,
) -> tuple[dict[str, Tensor], Any]:
    """One training step, its terms and new memory; the seconds of every part are appended to `timings`."""

    now = clock(device)
    parts = {f"{name} {method}": (f"{name}.{method}",) for name, _ in model.named_children() for method in PART_METHODS}
    with timed_parts(model, parts, timings, device):
        begin = now()
        with torch.autocast(device.type, dtype=torch.bfloat16, enabled=autocast):
            output, memory = model(batch, memory)
            forward = now()
            terms = model.loss(output, batch)
        loss = now()
        terms["total"].backward()
        backward = now()
    model.zero_grad(set_to_none=True)
    for name, seconds in {
        "all parts forward": forward - begin,
        "losses and targets": loss - forward,
        "backward": backward - loss,
        "whole step": backward - begin,
    }.items():
        timings.setdefault(name, []).append(seconds)
    return {name: value.detach() for name, value in terms.items()}, memory


def clock(device: torch.device) -> Callable[[], float]:
    """Seconds, read when everything queued on a GPU is done."""

    def now() -> float:
        if device.type == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter()

    return now


@contextmanager
def timed_parts(
    model: nn.Module,
    parts: dict[str, tuple[str, ...]],  # by name the methods to time, as in `module.method`
    timings: dict[str, list[float]],
    device: torch.device,
) -> Iterator[None]:
    """Within the context every call of these methods appends its seconds to `timings` under the part's name.

    A method that the model lacks is left out.
    """
    now, modules = clock(device), dict(model.named_modules())

    def timed(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            started = now()
            result = function(*arguments, **named)
            timings.setdefault(name, []).append(now() - started)
            return result

        return call

    replaced = []
    for name, paths in parts.items():
        for owner, _, method in (path.rpartition(".") for path in paths):
            if hasattr(modules.get(owner), method):
                setattr(modules[owner], method, timed(name, getattr(modules[owner], method)))
                replaced.append((modules[owner], method))
    try:
        yield
    finally:
        for module, method in replaced:
            delattr(module, method)


def report_latency(command: Config, overrides: list[str]) -> None:
    """Measure a checkpoint's own model on its own validation frames, print it, and write `latency.json` into `out`."""
    if command.checkpoint is None:
        raise ConfigError("suite=latency measures a trained model; give checkpoint=PATH of one")
    if command.out:
        make_writable(Path(command.out), "out")
    path = Path(command.checkpoint)
    checkpoint = read_checkpoint(path)
    config = restore_config(checkpoint["horizon3d"]["config"], overrides)
    detector = StreamingDetector.restore(config, checkpoint, path, chosen_device(config))
    datamodule = build_datamodule(config, data_root(config, write=False))
    dptf = getattr(config.model, "dptf", None)
    result = benchmark_latency(detector, datamodule, dptf.num_frames if dptf is not None else 0)
    if is_busy(result["load"], result["cores"]):
        print(
            f"warning: the load was {result['load']:.1f} on {result['cores']} cores when this began: the machine is "
            "busy, and the latencies are not those of the model alone; measure again when nothing else runs"
        )
    content = {"format": LATENCY_FORMAT, **result, "precision": config.precision, "commit": current_commit()}
    if command.out:  # first: what took long is safe
        write_json(Path(command.out) / "latency.json", content)
    shown = {name: value for name, value in result.items() if name not in ("ms", "spread_ms")}
    for name, key in (("seconds", "ms"), ("spread", "spread_ms")):
        shown[name] = {part: value / 1e3 for part, value in result[key].items()}
    print(markdown({"suite": "latency", "overrides": overrides, "machine": machine(), "result": shown}))
    if command.out:
        print(f"written: {Path(command.out) / 'latency.json'}")


def benchmark_latency(
    detector: StreamingDetector, datamodule: DetectionDataModule, memory_frames: int
) -> dict[str, Any]:
    """Median milliseconds of a frame and of its parts, from the frame on the device to its boxes; reading is not in it.

    The spread is the range of the middle half. Frames count once the memory is full, or as full as scenes are long.
    `load` is how many processes wanted a core over the minute before, of `cores`.
    `memory_gb` is the largest that torch held on a GPU, or the process with its libraries on a CPU, in 1e9 bytes.
    """
    device, now, load = detector.device, clock(detector.device), os.getloadavg()[0]
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats()
    scenes = scenes_of(datamodule.index, split_samples(datamodule.index, datamodule.config.split))
    full = min(memory_frames, max(map(len, scenes)) - 1)
    frames, measured, seen = endless_stream(datamodule), [], 0
    while len(measured) < MEASURED_FRAMES:
        frame, number = next(frames)
        frame, timings = frame.to(device), {}
        with timed_parts(detector.model, LATENCY_PARTS, timings, device):
            begin = now()
            detector.run(frame)
            total = now() - begin
        seen += 1
        if seen > WARM_UP_FRAMES and number >= full:
            measured.append({name: 1e3 * sum(calls) for name, calls in timings.items()} | {"total": 1e3 * total})
    columns = {name: [row[name] for row in measured] for name in (*LATENCY_PARTS, "total") if name in measured[0]}
    quartiles = {name: statistics.quantiles(values, n=4) for name, values in columns.items()}
    return {
        "ms": {name: middle for name, (_, middle, _) in quartiles.items()},
        "spread_ms": {name: high - low for name, (low, _, high) in quartiles.items()},
        "fps": 1e3 / quartiles["total"][1],
        "memory_gb": peak_bytes(device) / 1e9,
        "frames": len(measured),
        "device": str(device),
        "processor": torch.cuda.get_device_name() if device.type == "cuda" else processor(),
        "threads": torch.get_num_threads(),
        "load": round(load, 2),
        "cores": os.cpu_count() or 1,
    }


def endless_stream(datamodule: DetectionDataModule) -> Iterator[tuple[FrameBatch, int]]:
    """The validation frames over and over, each with its place in its scene."""
    while True:
        number = 0
        for frame in datamodule.stream():
            number = 0 if bool(frame.starts[0]) else number + 1
            yield frame, number


def benchmark_reader(config: Config) -> dict[str, Any]:
    """Frames per second of reading, augmenting and batching in this process, on one thread."""
    torch.set_num_threads(1)
    config.data.batch_size, config.data.num_workers = 1, 0
    datamodule = build_datamodule(config, data_root(config))
    batches = iter(datamodule.train_dataloader())
    next(batches)  # tables and first-use caches
    count, begin = 0, time.process_time()
    for _ in range(READER_FRAMES):
        if next(batches, None) is None:
            break
        count += 1
    seconds = time.process_time() - begin
    return {"frames": count, "cpu_seconds": seconds, "frames_per_second": count / seconds}


def chosen_device(config: Config) -> torch.device:
    """A GPU where there is one and `trainer.accelerator` does not say otherwise."""
    check_devices(config.trainer.accelerator.value, 1)
    on_gpu = torch.cuda.is_available() and config.trainer.accelerator is not Accelerator.cpu
    return torch.device("cuda" if on_gpu else "cpu")


def peak_bytes(device: torch.device) -> int:
    """The most that torch has held on a GPU, or that the process has held on a CPU."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated()
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def machine() -> dict[str, Any]:
    """What the numbers were measured on."""
    return {
        "processor": processor(),
        "threads": torch.get_num_threads(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def processor() -> str:
    """Name of the CPU where the system tells it."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    return next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def number(value: Any) -> str:
    """Four digits for a float, thousands apart for an integer."""
    if isinstance(value, float):
        return f"{value:.4g}"
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)


def markdown(result: dict[str, Any]) -> str:
    """The result as Markdown: a table of seconds where there are some, every other number in a list."""
    lines = [f"# Benchmark: {result['suite']}", "", f"`python -m src.benchmark {' '.join(result['overrides'])}`", ""]
    lines += [f"- {name}: {value}" for name, value in result["machine"].items() if value is not None]
    content = dict(result["result"])
    seconds, spread = content.pop("seconds", {}), content.pop("spread", {})
    if seconds:
        lines += ["", "| part | ms (median) | spread ms |", "|---|---|---|"]
        lines += [f"| {name} | {1e3 * value:.1f} | {1e3 * spread[name]:.1f} |" for name, value in seconds.items()]
    lines.append("")
    for name, value in content.items():
        shown = value if isinstance(value, dict) else {name: value}
        prefix = f"{name}: " if isinstance(value, dict) else ""
        cells = [f"{key} {number(item)}" for key, item in shown.items()]
        lines.append(f"- {prefix}{', '.join(cells)}")
    return "\n".join(lines)


if __name__ == "__main__":
    run_command(main)
