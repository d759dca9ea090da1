"""What the numbers were measured on, and that machine's roofline."""

from __future__ import annotations

import os
import platform
import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from src.benchmark.timing import clock, interleaved
from src.ops.precision import Precision
from src.report.result_schema import is_busy

# Square products large enough to reach the highest rate, small enough for seconds on two cores.
GEMM_SIZE = {"cpu": 2048, "cuda": 8192}
# Far beyond every cache, so that a copy moves memory.
COPY_BYTES = {"cpu": 256 * 2**20, "cuda": 2 * 2**30}
ROUNDS = 15
BUSY_WINDOW_S = 1.0  # a hundred ticks of each core


def describe_machine() -> dict[str, Any]:
    """Processor, threads, versions and how busy it was when the measurement began."""
    return {
        "processor": processor(),
        "cores": os.cpu_count() or 1,
        "threads": torch.get_num_threads(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "memory_gib": memory_gib(),
        "system": platform.system(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "load": round(busy_cores(), 2),
    }


def busy_warning(machine: dict[str, Any]) -> str | None:
    """A warning for numbers that were measured beside other work; None on a quiet machine."""
    if not is_busy(machine["load"], machine["cores"]):
        return None
    return (
        f"warning: {machine['load']:.1f} of {machine['cores']} cores were at work when this began: the machine is "
        "busy, so times are too long; ratios of what was measured in turns still hold; measure again when nothing "
        "else runs"
    )


def busy_cores() -> float:
    """How many cores were at work during one second in which this process waits.

    Where the system does not count that (Linux does), its load average, which still holds what ended a minute ago.
    """
    before = _core_seconds()
    if before is None:
        return os.getloadavg()[0]
    time.sleep(BUSY_WINDOW_S)
    worked, whole = (after - earlier for after, earlier in zip(_core_seconds() or before, before, strict=True))
    return (os.cpu_count() or 1) * worked / whole if whole else 0.0


def _core_seconds() -> tuple[int, int] | None:
    """Ticks of all cores at work, and of all in all (/proc/stat)."""
    try:
        line = Path("/proc/stat").read_text().split("\n", 1)[0]
    except OSError:
        return None
    user, nice, system, idle, waiting, *interrupts = map(int, line.split()[1:9])  # what comes after is in these already
    worked = user + nice + system + sum(interrupts)
    return worked, worked + idle + waiting


def processor() -> str:
    """Name of the CPU where the system reports it, else its architecture."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    return next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def memory_gib() -> float | None:
    """Memory of the machine where the system reports it."""
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
    except (AttributeError, ValueError, OSError):
        return None


def measure_roofline(device: torch.device) -> dict[str, float]:
    """Measured ceilings: GFLOP/s of matrix products by type and GB/s of a copy (bytes read plus bytes written).

    With torch's number of threads, each the fastest of some rounds. `bf16` is absent where the processor has no
    instructions of its own for it, which shows in a rate below that of fp32.
    """
    products = {name: Gemm(device, dtype) for name, dtype in (("fp32", torch.float32), ("bf16", torch.bfloat16))}
    timed = interleaved(products, clock(device), ROUNDS)
    rates = {f"{name}_gflops": gemm.flops / min(timed[name]) / 1e9 for name, gemm in products.items()}
    if rates["bf16_gflops"] < rates["fp32_gflops"]:
        del rates["bf16_gflops"]
    size = COPY_BYTES[device.type]
    source = torch.ones(size // 4, device=device)
    target = torch.empty_like(source)
    seconds = interleaved({"copy": lambda: target.copy_(source)}, clock(device), ROUNDS)["copy"]
    return rates | {"copy_gbps": 2 * size / min(seconds) / 1e9}


class Gemm:
    """A matrix product large enough to reach the machine's rate; a call makes it, `flops` of arithmetic."""

    def __init__(self, device: torch.device, dtype: torch.dtype = torch.float32) -> None:
        size = GEMM_SIZE[device.type]
        self._a, self._b = (torch.randn(size, size, device=device).to(dtype) for _ in range(2))
        self.flops = 2 * size**3

    def __call__(self) -> Tensor:
        return self._a @ self._b


def gemm_rate(roofline: dict[str, float], precision: str) -> float:
    """GFLOP/s that work in a precision could reach."""
    wanted = "fp32_gflops" if precision == Precision.FULL else "bf16_gflops"
    return roofline.get(wanted, roofline["fp32_gflops"])
