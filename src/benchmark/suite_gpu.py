"""suite=gpu: what a frame and a step cost on this GPU, beside what was counted without one. Needs no data."""

from __future__ import annotations

import statistics
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import torch

from src.benchmark.cases import Case
from src.benchmark.scenes import ROADS, Highway
from src.benchmark.suite_launches import count, made_batch, make_case
from src.benchmark.timing import clock, milliseconds, seconds_of
from src.config import Config
from src.errors import ConfigError

FRAMES = 1000
DRAWS = 20  # frames of different counts, in turn
WARM_UP = 2 * DRAWS
STEPS = 30
BATCH_SIZES = (1, 4, 8)


def measure(config: Config, tree: dict[str, Any]) -> dict[str, Any]:
    """Wall time, busy time and waits of frames, seconds of steps by batch size. Raises ConfigError without a GPU."""
    device = config.trainer.device()
    if device.type != "cuda":
        raise ConfigError(f"suite=gpu measures on a GPU, but trainer.accelerator gives {device}")
    counted, _ = count(counting := make_case(config), counting.prepared, counting.infer)
    case = full_case(config, device)
    frames = frame_seconds(case, ROADS[config.scale], FRAMES)
    waits = waits_of(case.infer)
    return {
        "notes": [
            f"{config.model.name}, scale {config.scale}, {config.phase.name}, {config.precision} on "
            f"{torch.cuda.get_device_name(device)}. {FRAMES} made frames of {DRAWS} draws, a full memory, "
            "fresh weights.",
        ],
        "a frame": [
            {
                **milliseconds(frames),
                "p99 ms": 1e3 * statistics.quantiles(frames, n=100)[98],
                "busy ms": 1e3 * busy_seconds(case.infer),
                "waits": waits,
                **{f"{name} counted": value for name, value in counted.totals().items()},
            }
        ],
        "a training step": [step_row(config, device, size) for size in BATCH_SIZES],
        "peak_memory_mib": int(torch.cuda.max_memory_allocated() / 2**20),
    }


def full_case(config: Config, device: torch.device) -> Case:
    """The configured model, its images in full size, on the road of the scale."""
    return make_case(config, device, ROADS[config.scale], tuple(config.backbone.image_size_px))


def frame_seconds(case: Case, road: Highway, frames: int) -> list[float]:
    """Of frames whose points differ from one to the next, after some to warm up."""
    size, draws = tuple(case.batch.images.shape[-2:]), []
    for draw in range(DRAWS):
        other = made_batch(len(case.batch), road, size, seed=draw)
        own = {"timestamps_s": case.batch.timestamps_s, "global_from_ego": case.batch.global_from_ego}
        draws.append(replace(other.to(case.device), **own))
    seconds = []
    for number in range(WARM_UP + frames):
        case.batch = draws[number % DRAWS]
        seconds.append(seconds_of(case.infer, clock(case.device)))
    return seconds[-frames:]


def step_row(config: Config, device: torch.device, batch_size: int) -> dict[str, Any]:
    """Forward, losses and backward of a batch."""
    case = full_case(replace(config, data=replace(config.data, batch_size=batch_size)), device)
    seconds = [seconds_of(case.step, clock(device)) for _ in range(STEPS + 3)][3:]
    row = {"batch": batch_size, **milliseconds(seconds), "frames/s": batch_size / statistics.median(seconds)}
    return row | {"busy ms": 1e3 * busy_seconds(case.step), "waits": waits_of(case.step)}


def busy_seconds(function: Callable[[], Any]) -> float:
    """How long kernels and copies of a call take on the GPU."""
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        function()
        torch.cuda.synchronize()
    return 1e-6 * sum(event.self_device_time_total for event in profile.key_averages())


def waits_of(function: Callable[[], Any]) -> int:
    """How often a call makes the host wait, as CUDA tells."""
    with _told_of_waits() as found:
        function()
    return sum("synchroniz" in str(warning.message) for warning in found)


@contextmanager
def _told_of_waits() -> Iterator[list[warnings.WarningMessage]]:
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        try:
            yield found
        finally:
            torch.cuda.set_sync_debug_mode("default")
