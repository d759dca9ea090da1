"""Seconds and bytes of functions and of a model's parts, on the CPU or on a GPU."""

from __future__ import annotations

import ctypes
import gc
import math
import resource
import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import nn

from src.benchmark.parts import Paths, backward_from, wrapped_parts
from src.ops.scratch import release_scratch
from src.reliability.cpu import peak_resident_bytes

PATIENCE = 4.0  # a first call that takes so many times what a candidate may take is its only one


# torch.utils.benchmark's clock waits for any GPU there is, and so gives a CPU's process the memory of a CUDA context.
def clock(device: torch.device) -> Callable[[], float]:
    """Wall seconds, read when everything queued on a GPU is done."""

    def now() -> float:
        if device.type == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter()

    return now


def median_iqr(values: list[float]) -> tuple[float, float]:
    """The median and the interquartile range; with fewer than four values their whole range."""
    if len(values) < 4:
        return statistics.median(values), max(values) - min(values)
    low, middle, high = statistics.quantiles(values, n=4)
    return middle, high - low


def milliseconds(seconds: list[float], prefix: str = "") -> dict[str, float]:
    """Columns of a row: the median and, after ±, the interquartile range."""
    middle, iqr = median_iqr(seconds)
    return {f"{prefix}ms": 1e3 * middle, f"{prefix}± ms": 1e3 * iqr}


def ratio_columns(seconds: Mapping[str, list[float]], times: Mapping[str, float] | None = None) -> dict[str, float]:
    """How many times faster `ours` is than each baseline, then the times; a baseline counts so many `times`."""
    others = {
        name: (times or {}).get(name, 1.0) * statistics.median(seconds[name]) for name in seconds if name != "ours"
    }
    row = {f"x faster than {name}": value / statistics.median(seconds["ours"]) for name, value in others.items()}
    return row | milliseconds(seconds["ours"]) | {f"{name} ms": 1e3 * value for name, value in others.items()}


def seconds_of(function: Callable[[], Any], now: Callable[[], float]) -> float:
    """Seconds of one call. Its result is freed, so that the next call reuses the memory as it would in a loop."""
    begin = now()
    result = function()
    elapsed = now() - begin
    del result
    return elapsed


# torch.utils.benchmark.Timer measures one candidate after the other, and warms each up by two calls of it.
def interleaved(
    candidates: Mapping[str, Callable[[], Any]],
    now: Callable[[], float],
    rounds: int,
    budget_s: float = math.inf,  # of each candidate
) -> dict[str, list[float]]:
    """Seconds of every candidate, called in turns: what else the machine does then slows all of them alike.

    The first call of each does not count: it warms up and sets how many rounds fit into the budget, at least one. If
    it alone takes several times the budget, it is the only one and counts.
    """
    first = {name: seconds_of(function, now) for name, function in candidates.items()}
    endless = [name for name in candidates if first[name] > PATIENCE * budget_s]
    seconds = {name: [first[name]] if name in endless else [] for name in candidates}
    for number in range(rounds):
        for name, function in candidates.items():
            if name not in endless and (number == 0 or (number + 1) * first[name] <= budget_s):
                seconds[name].append(seconds_of(function, now))
    return seconds


MODES = {"forward": torch.no_grad(), "f+b": lambda function: lambda: backward_from(function())}
"""How an operation is called, by the names that pages use."""


@contextmanager
def timed_parts(model: nn.Module, parts: Paths, now: Callable[[], float]) -> Iterator[dict[str, float]]:
    """Within the context the calls of every part add their seconds to what it yields, under the part's name."""
    seconds: dict[str, float] = {}

    def timed(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            started = now()
            result = function(*arguments, **named)
            seconds[name] = seconds.get(name, 0.0) + now() - started
            return result

        return call

    with wrapped_parts(model, parts, timed):
        yield seconds


# ---------------------------------------------------------------- bytes


def peak_bytes(device: torch.device) -> int:
    """The most that torch has held on a GPU, or that the process has held on a CPU."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated()
    return peak_resident_bytes(resource.RUSAGE_SELF)


def added_mib(function: Callable[[], Any], device: torch.device) -> float | None:
    """The most that a call takes beyond what was held before it; None where the system does not report it.

    On a GPU what torch allocates; on a CPU pages of the process (Linux), after the allocator has given back what it
    kept of earlier calls. Memory that convolutions use again is part of the call.
    """
    gc.collect()
    release_scratch()
    if not forget_peak(device):
        return None
    if device.type == "cuda":
        before = torch.cuda.memory_allocated()
        function()
        torch.cuda.synchronize()
        return (torch.cuda.max_memory_allocated() - before) / 2**20
    before = status_bytes("VmRSS")
    function()
    return max(0, status_bytes("VmHWM") - before) / 2**20


def forget_peak(device: torch.device) -> bool:
    """Let `peak_bytes` begin anew from what is held now; False where the system does not do that (Linux does)."""
    if device.type == "cuda":
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        return True
    if not trim_heap():
        return False
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return False
    return True


def trim_heap() -> bool:
    """Give freed memory that the C allocator keeps back to the system; False with a C library that cannot."""
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except (OSError, AttributeError):
        return False
    return True


def status_bytes(key: str, process: int | str = "self") -> int | None:
    """A line of a process's /proc/PID/status (Linux), None where there is none."""
    try:
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith(key + ":")), None)
