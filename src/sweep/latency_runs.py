"""Latency of a sweep's rows, measured one after the other once nothing trains any more."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from pathlib import Path

from src.errors import HorizonError
from src.reliability.checkpoints import LAST
from src.report.results import publish_latency, read_results
from src.report.sweep_record import SweepRecord
from src.sweep.runner import Runner
from src.sweep.sweep_study import file_lock

logger = logging.getLogger(__name__)


def measure_latencies(
    record: SweepRecord, outputs: Path, reports: Path, runner: Runner, every: bool = False
) -> list[str]:
    """Measure one finished run of each row that none is measured of. Returns what failed, in a line each; it is logged,
    and the row is left as it was.

    A run whose weights are not here is measured only with `every`, which measures all rows, again where they have been:
    of such a run fresh weights, and the result in `reports` is given its latency. Measurements of all sweeps of these
    outputs come one after the other.
    """
    problems: list[str] = []
    measured: set[str] = set()
    for label, run_id, trained in runs_to_measure(record, outputs, reports, every):
        folder = outputs / run_id if trained else outputs / "sweeps" / "latency" / run_id
        with file_lock(outputs / "sweeps" / ".latency.lock"):
            if run_id in measured or ((folder / "latency.json").is_file() and not every):
                continue  # for another row, or by a runner beside this one
            measured.add(run_id)
            logger.info("[%s]: measuring the latency of %s", label, run_id)
            what = [f"checkpoint={folder / 'checkpoints' / LAST}"] if trained else record.runs[run_id].overrides
            reason = measure_latency(run_id, trained, folder, what, outputs, reports, runner)
        if reason:
            log = runner.launcher.log_of(f"{run_id}.latency")
            problems.append(f"[{label}]: no latency of {run_id}: {reason}; log: {log}")
            logger.warning("%s", problems[-1])
    return problems


def runs_to_measure(record: SweepRecord, outputs: Path, reports: Path, every: bool) -> Iterator[tuple[str, str, bool]]:
    """Label of each row, the run of it to measure, and whether its weights are here."""
    results, _ = read_results(reports, record.scale)
    for label, by_seed in record.rows.items():
        done = [run_id for _, run_id in sorted(by_seed.items()) if record.runs[run_id].state == "done"]
        here = [run_id for run_id in done if (outputs / run_id / "checkpoints" / LAST).is_file()]
        timed = [
            run_id
            for run_id in done
            if (outputs / run_id / "latency.json").is_file() or (run_id in results and results[run_id].latency)
        ]
        if every:
            chosen = timed or here[:1] or done[:1]
        else:
            chosen = [] if timed else here[:1]
        yield from ((label, run_id, run_id in here) for run_id in chosen)


def measure_latency(
    run_id: str, trained: bool, folder: Path, what: list[str], outputs: Path, reports: Path, runner: Runner
) -> str:
    """Measure one run in a process of its own and publish it. Returns why that failed; empty when it did not."""
    machine = next((spec.machine for spec in runner.plan.specs.values()), [])
    command = latency_command(outputs, folder, [*what, *machine])
    status = runner.launcher.run_command(command, f"{run_id}.latency", 0, runner.stop)
    if status.code:
        return status.reason
    try:
        if trained:
            runner.publish(folder)
        else:
            publish_latency(folder, reports, run_id)
    except (HorizonError, OSError) as error:
        return str(error)
    return status.reason


def latency_command(outputs: Path, folder: Path, words: list[str]) -> list[str]:
    """What measures a checkpoint's latency, or that of fresh weights, into `latency.json` of a folder."""
    places = [f"paths.outputs={outputs}", f"out={folder}"]
    words = [word for word in words if not word.startswith(("paths.outputs=", "out="))]
    return [sys.executable, "-m", "src.benchmark", "suite=latency", *words, *places]
