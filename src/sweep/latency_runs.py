"""Latency of a sweep's rows, measured one after the other once nothing trains any more."""

from __future__ import annotations

import logging
import sys
from pathlib import Path

from src.reliability.checkpoints import LAST
from src.report.results import publish_latency, read_results
from src.report.sweep_record import SweepRecord
from src.sweep.plan import RunSpec
from src.sweep.runner import Runner
from src.sweep.sweep_study import file_lock

logger = logging.getLogger(__name__)


def measure_latencies(record: SweepRecord, outputs: Path, reports: Path, runner: Runner, every: bool = False) -> int:
    """Measure one finished run of each row that none is measured of; a failure is logged and leaves the row as it was.

    A run whose weights are not here is measured only with `every`, which measures all rows, again where they have been:
    of such a run fresh weights, and the result in `reports` is given its latency. Measurements of all sweeps of these
    outputs come one after the other. Returns how many were made.
    """
    measured, results = 0, read_results(reports, record.scale)[0]
    for label, by_seed in record.rows.items():
        done = [run_id for _, run_id in sorted(by_seed.items()) if record.runs[run_id].state == "done"]
        here = [run_id for run_id in done if run_id not in runner.plan.published]  # the others left no weights
        timed = [
            run_id
            for run_id in done
            if (outputs / run_id / "latency.json").is_file() or (run_id in results and results[run_id].latency)
        ]
        choice = [*timed, *here, *done] if every else here if not timed else []
        if not choice:
            continue
        run_id = choice[0]
        folder = outputs / run_id if run_id in here else outputs / "sweeps" / "latency" / run_id
        with file_lock(outputs / "sweeps" / ".latency.lock"):
            if (folder / "latency.json").is_file() and not every:
                continue  # a runner beside this one has measured it
            logger.info("[%s]: measuring the latency of %s", label, run_id)
            command = latency_command(outputs, runner.plan.specs[run_id], folder, run_id in here)
            status = runner.launcher.run_command(command, f"{run_id}.latency", 0, runner.stop)
        if status.code or not (folder / "latency.json").is_file():
            log = runner.launcher.log_of(f"{run_id}.latency")
            reason = status.reason or "it left no latency.json"
            logger.warning("[%s]: no latency of %s: %s; log: %s", label, run_id, reason, log)
            continue
        if run_id in here:
            runner.publish(folder)
        else:
            publish_latency(folder, reports, run_id)
        measured += 1
    return measured


def latency_command(outputs: Path, spec: RunSpec, folder: Path, trained: bool) -> list[str]:
    """What measures the latency of a finished run into `latency.json` of a folder: its own, or any without weights."""
    what = [f"checkpoint={folder / 'checkpoints' / LAST}"] if trained else [*spec.overrides, *spec.machine]
    places = [f"paths.outputs={outputs}", f"out={folder}"]
    words = [word for word in what if not word.startswith(("paths.outputs=", "out="))]
    return [sys.executable, "-m", "src.benchmark", "suite=latency", *words, *places]
