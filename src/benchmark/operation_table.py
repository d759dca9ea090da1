"""Where the time of a call goes, operation by operation: what a gap to the roofline bound is made of."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile

OPERATIONS_NOTE = (
    "Operations: one call under torch's profiler, longest self time first. Operations of ours are named by their "
    "classes, and their self time is the interpreter's."
)
PRODUCTS = ("aten::mm", "aten::addmm", "aten::bmm", "aten::baddbmm")
NUM_ROWS = 16  # the rest is one row: it would be a long list of thousandths


def operation_table(function: Callable[[], Any], device: torch.device) -> list[dict[str, Any]]:
    """Rows of the operations with the longest self time in one call, after one to warm up.

    `GFLOP/s` stands at matrix products. Profiling costs some time of its own, most where operations are short.
    """
    function()
    on_gpu = device.type == "cuda"
    activities = [ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if on_gpu else [])]
    with profile(activities=activities, with_flops=True) as profiled:
        function()
    events = profiled.key_averages()
    time_of = "self_device_time_total" if on_gpu else "self_cpu_time_total"
    events = sorted(events, key=lambda event: getattr(event, time_of), reverse=True)
    total_us = sum(getattr(event, time_of) for event in events)
    rows = []
    for event in events[:NUM_ROWS]:
        time_us = getattr(event, time_of)
        row = {
            "operation": event.key.removeprefix("aten::"),
            "% of time": 100 * time_us / total_us,
            "ms": time_us / 1e3,
            "calls": event.count,
        }
        rows.append(row | ({"GFLOP/s": event.flops / time_us / 1e3} if event.key in PRODUCTS and time_us else {}))
    rest_us = total_us - sum(1e3 * row["ms"] for row in rows)
    others = {"operation": f"{max(0, len(events) - NUM_ROWS)} others", "% of time": 100 * rest_us / total_us}
    return [*rows, others | {"ms": rest_us / 1e3, "calls": sum(event.count for event in events[NUM_ROWS:])}]
