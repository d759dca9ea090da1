"""Latency of a sweep's rows, measured one after the other once nothing trains any more."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

from src.report.sweep_record import SweepRecord
from src.sweep.runner import Runner
from src.sweep.sweep_study import file_lock

logger = logging.getLogger(__name__)


def measure_latencies(record: SweepRecord, outputs: Path, command: Callable[[Path], list[str]], runner: Runner) -> int:
    """Measure each row's first finished seed that lacks `latency.json`; a failure is logged and leaves the row without.

    Measurements of all sweeps of these outputs come one after the other. Returns how many were made.
    """
    measured = 0
    for label, by_seed in record.rows.items():
        done = [run_id for _, run_id in sorted(by_seed.items()) if record.runs[run_id].state == "done"]
        done = [run_id for run_id in done if run_id not in runner.plan.published]  # they left no weights here
        if any((outputs / run_id / "latency.json").is_file() for run_id in done) or not done:
            continue
        folder = outputs / done[0]
        with file_lock(outputs / "sweeps" / ".latency.lock"):
            if (folder / "latency.json").is_file():
                continue  # a runner beside this one has measured it
            logger.info("[%s]: measuring the latency of %s", label, done[0])
            status = runner.launcher.run_command(command(folder), f"{done[0]}.latency", 0, runner.stop)
        if status.code or not (folder / "latency.json").is_file():
            log = runner.launcher.log_of(f"{done[0]}.latency")
            reason = status.reason or "it left no latency.json"
            logger.warning("[%s]: no latency of %s: %s; log: %s", label, done[0], reason, log)
            continue
        runner.publish(folder)
        measured += 1
    return measured
