"""Seconds and bytes of functions and of a model's parts, on the CPU or on a GPU."""

from __future__ import annotations

import ctypes
import gc
import resource
import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from src.config import Accelerator, Config
from src.ops.sparse_conv_tiled import release_scratch
from src.reliability.processes import check_devices

PATIENCE = 4.0  # a first call that takes so many times what a candidate may take is its only one


def chosen_device(config: Config) -> torch.device:
    """A GPU where there is one and `trainer.accelerator` does not say otherwise."""
    check_devices(config.trainer.accelerator.value, 1)
    on_gpu = torch.cuda.is_available() and config.trainer.accelerator is not Accelerator.cpu
    return torch.device("cuda" if on_gpu else "cpu")


def clock(device: torch.device) -> Callable[[], float]:
    """Seconds, read when everything queued on a GPU is done."""

    def now() -> float:
        if device.type == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter()

    return now


def median_spread(values: list[float]) -> tuple[float, float]:
    """The median and the range of the middle half; with fewer than four values their whole range."""
    if len(values) < 4:
        return statistics.median(values), max(values) - min(values)
    low, middle, high = statistics.quantiles(values, n=4)
    return middle, high - low


def interleaved(
    candidates: Mapping[str, Callable[[], Any]],
    device: torch.device,
    rounds: int,
    warm_up: int = 1,  # rounds that do not count
) -> dict[str, list[float]]:
    """Seconds of every candidate, taken in turns: what else the machine does then strikes all of them alike."""
    now = clock(device)
    seconds: dict[str, list[float]] = {name: [] for name in candidates}
    for number in range(warm_up + rounds):
        for name, function in candidates.items():
            begin = now()
            result = function()
            elapsed = now() - begin
            del result  # before the next candidate: its memory would else be fresh instead of reused
            if number >= warm_up:
                seconds[name].append(elapsed)
    return seconds


def in_turns(
    candidates: Mapping[str, Callable[[], Any]],
    device: torch.device,
    rounds: int,
    budget_s: float,  # of each candidate
) -> dict[str, list[float]]:
    """As `interleaved`, with fewer rounds for what is slow.

    The first call of each tells how slow it is and does not count, unless it alone takes several times the budget.
    """
    first = {name: values[0] for name, values in interleaved(candidates, device, 1, warm_up=0).items()}
    endless = [name for name in candidates if first[name] > PATIENCE * budget_s]
    seconds: dict[str, list[float]] = {name: [first[name]] if name in endless else [] for name in candidates}
    for number in range(rounds):
        due = {
            name: function
            for name, function in candidates.items()
            if name not in endless and number < max(1, budget_s // max(first[name], 1e-9))
        }
        for name, values in interleaved(due, device, 1, warm_up=0).items():
            seconds[name] += values
    return seconds


def without_gradient(function: Callable[[], Any]) -> Callable[[], Any]:
    """The function as inference calls it."""

    def call() -> Any:
        with torch.no_grad():
            return function()

    return call


def with_gradient(function: Callable[[], Any]) -> Callable[[], None]:
    """The function and, from gradients of one, its backward pass."""

    def call() -> None:
        result = function()
        outputs = [result] if isinstance(result, Tensor) else [x for x in result if isinstance(x, Tensor)]
        outputs = [x for x in outputs if x.requires_grad]
        torch.autograd.backward(outputs, [torch.ones_like(x) for x in outputs])

    return call


@contextmanager
def replaced_methods(
    model: nn.Module,
    parts: Mapping[str, tuple[str, ...]],  # by name the methods to wrap, as in `module.method`
    wrap: Callable[[str, str, Callable[..., Any]], Callable[..., Any]],  # of part, path and the method
) -> Iterator[None]:
    """Within the context these methods of the model are wrapped; one that the model lacks is left out."""
    modules, replaced = dict(model.named_modules()), []
    for name, paths in parts.items():
        for path in paths:
            owner, _, method = path.rpartition(".")
            if hasattr(modules.get(owner), method):
                setattr(modules[owner], method, wrap(name, path, getattr(modules[owner], method)))
                replaced.append((modules[owner], method))
    try:
        yield
    finally:
        for module, method in replaced:
            delattr(module, method)


@contextmanager
def timed_parts(
    model: nn.Module,
    parts: Mapping[str, tuple[str, ...]],  # by name the methods to time, as in `module.method`
    timings: dict[str, list[float]],
    device: torch.device,
) -> Iterator[None]:
    """Within the context every call of these methods appends its seconds to `timings` under the part's name.

    A method that the model lacks is left out.
    """
    now = clock(device)

    def timed(name: str, path: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            started = now()
            result = function(*arguments, **named)
            timings.setdefault(name, []).append(now() - started)
            return result

        return call

    with replaced_methods(model, parts, timed):
        yield


def peak_bytes(device: torch.device) -> int:
    """The most that torch has held on a GPU, or that the process has held on a CPU."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated()
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def added_bytes(function: Callable[[], Any], device: torch.device) -> int | None:
    """The most that a call takes beyond what was held before it; None where the system does not tell.

    On a GPU what torch allocates; on a CPU pages of the process (Linux), after the allocator has given back what it
    kept of earlier calls. Memory that convolutions use again is part of the call.
    """
    gc.collect()
    release_scratch()
    if device.type == "cuda":
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        function()
        torch.cuda.synchronize()
        return torch.cuda.max_memory_allocated() - before
    try:
        ctypes.CDLL(None).malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
    except (OSError, AttributeError):
        return None
    before = _status_bytes("VmRSS")
    function()
    return max(0, _status_bytes("VmHWM") - before)


def _status_bytes(key: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(key + ":"))
