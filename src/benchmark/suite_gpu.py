"""suite=gpu: what a frame and a step cost on this GPU, beside what was counted without one. Needs no data."""

from __future__ import annotations

import itertools
import statistics
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import torch

from src.benchmark.cases import KEY_FRAME_S, OCCUPIED_CELLS, Case, expect_trained_occupancy, fill_memory, made_case
from src.benchmark.launches import count, small_case
from src.benchmark.scenes import ROADS, made_batch
from src.benchmark.timing import clock, median_iqr, milliseconds, seconds_of, timed_parts
from src.config import Config
from src.errors import ConfigError
from src.models.deploy.whole_frames import WholeFrames
from src.ops import backend
from src.ops.precision import Precision
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D

DRAWS = 20  # frames of different counts, in turn
WARM_UP = 2 * DRAWS
FRAMES, BUDGET_S = 1000, 10.0  # of each way to run a frame: the most, and when it ends before
PART_FRAMES = 20
STEPS = 20
BATCH_SIZES = (1, 4, 8)
LAUNCHED, GRAPH = "launched one by one", "one CUDA graph"

Step = Callable[[FrameBatch], Boxes3D | None]
"""Takes a frame on the host to its boxes, on the host too."""


def measure(config: Config, tree: dict[str, Any]) -> dict[str, Any]:
    """Wall time, busy time and waits of frames, seconds of steps by batch size. Raises ConfigError without a GPU."""
    device = config.trainer.device()
    if device.type != "cuda":
        raise ConfigError(f"suite=gpu measures on a GPU, but trainer.accelerator gives {device}")
    counting = small_case(replace(config, precision=Precision.FULL))  # the simulated device has no autocast
    counted, _ = count(counting, counting.prepared, counting.infer)
    case = full_case(config, device)
    expect_trained_occupancy(case, OCCUPIED_CELLS[config.scale])
    fill_memory(case, config.model.memory_frames)
    waits = waits_of(case.infer)
    return {
        "notes": [
            f"{config.model.name}, scale {config.scale}, {config.phase.name}, {config.precision} on "
            f"{torch.cuda.get_device_name(device)}, fresh weights. Busy is how long the GPU computes and copies.",
            "In frames Gaussians, where there are any, occupy what trained ones do. A frame: "
            f"{DRAWS} draws in turn, from the host to their boxes there, each remembered by the next. A frame on the "
            "GPU, and its parts: one draw that lies there, with a full memory; `counted` in float32 on a small road, "
            "as suite=launches counts. A step is forward, losses and backward; its Gaussians fill the map.",
        ],
        "a frame": frame_rows(case, config.scale),
        "a frame on the GPU": [
            {
                "waits": waits,
                "busy ms": 1e3 * busy_seconds(case.infer),
                **{f"{name} counted": value for name, value in counted.totals().items()},
            }
        ],
        "a frame by part, each waited for": part_rows(case),
        "a training step": [step_row(config, device, size) for size in BATCH_SIZES],
        "peak_memory_mib": int(torch.cuda.max_memory_allocated() / 2**20),
    }


def full_case(config: Config, device: torch.device) -> Case:
    """The configured model, its images in full size, on the road of the scale."""
    return made_case(config, device, ROADS[config.scale], tuple(config.backbone.image_size_px))


def frame_rows(case: Case, scale: str) -> list[dict[str, Any]]:
    """A row for each way to run a frame."""
    size = tuple(case.batch.images.shape[-2:])
    draws = [made_batch(1, ROADS[scale], size, seed=draw) for draw in range(DRAWS)]
    ways: dict[str, Step] = {LAUNCHED: launched(case)}
    form = case.prepared.fixed_form() if backend.chosen() == backend.TRITON else None
    if form is not None:
        with torch.inference_mode():
            ways[GRAPH] = (whole := WholeFrames(form, case.device, captured=case.device.type == "cuda")).step
    rows = []
    for name, step in ways.items():
        with torch.inference_mode(), case.computing():
            frames = following(draws)
            seconds = frame_seconds(step, frames, clock(case.device))
            busy_ms = 1e3 * busy_seconds(lambda step=step, frames=frames: step(next(frames)))
        p99 = 1e3 * statistics.quantiles(seconds, n=100)[98] if len(seconds) >= 100 else None
        rows.append({"way": name, **milliseconds(seconds), "p99 ms": p99, "busy ms": busy_ms, "frames": len(seconds)})
        if name == GRAPH:
            rows[-1]["beyond a capacity"] = whole.refused
    return rows


def launched(case: Case) -> Step:
    """Frames as they come, each operation launched by the host."""
    memory = None

    def step(frame: FrameBatch) -> Boxes3D:
        nonlocal memory
        output, memory = case.prepared(frame.to(case.device), memory)
        (boxes,) = case.prepared.decode(output)
        return boxes.to("cpu")

    return step


def following(draws: list[FrameBatch]) -> Iterator[FrameBatch]:
    """The draws in turn without end, a key frame apart, of a truck that stands."""
    for number, draw in enumerate(itertools.cycle(draws)):
        yield replace(draw, timestamps_s=draw.timestamps_s + KEY_FRAME_S * number)


def frame_seconds(step: Step, frames: Iterator[FrameBatch], now: Callable[[], float]) -> list[float]:
    """Seconds of each frame after WARM_UP others: of FRAMES, or fewer once BUDGET_S is spent."""
    for _ in range(WARM_UP):
        step(next(frames))
    seconds: list[float] = []
    while len(seconds) < FRAMES and sum(seconds) < BUDGET_S:
        frame = next(frames)
        seconds.append(seconds_of(lambda frame=frame: step(frame), now))
    return seconds


def part_rows(case: Case) -> list[dict[str, Any]]:
    """Medians of the parts of Table 15, the host waiting for each."""
    now, found = clock(case.device), []
    for _ in range(PART_FRAMES):
        with timed_parts(case.prepared, case.model.latency_parts, now) as seconds:
            whole = seconds_of(case.infer, now)
        found.append(seconds | {"total": whole})
    columns = {name: median_iqr([row[name] for row in found]) for name in found[0]}
    return [{"part": name, "ms": 1e3 * middle, "± ms": 1e3 * iqr} for name, (middle, iqr) in columns.items()]


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
