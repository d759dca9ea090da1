"""How far a sweep is, in a line."""

from __future__ import annotations

import time
from collections import defaultdict
from pathlib import Path

from src.reporting.sweep_record import RunState, SweepRecord
from src.sweeping.runs import read_seconds


def progress_line(record: SweepRecord, outputs: Path, workers: int) -> str:
    """Done, running, left, failed, and the time left as far as finished runs of the same phase tell it."""
    unchosen = _unchosen(record)
    left = record.count("waiting") + unchosen
    words = [f"{record.count('done')} of {len(record.runs) + unchosen} done", f"{record.count('running')} running"]
    words.append(f"{left} left")
    words += [f"{record.count(state)} {state}" for state in ("failed", "pruned") if record.count(state)]
    if left or record.count("running"):
        seconds = seconds_left(record, outputs, workers)
        words.append("time left unknown yet" if seconds is None else f"about {duration(seconds)} left")
    return f"{record.study}: {', '.join(words)}"


def seconds_left(record: SweepRecord, outputs: Path, workers: int) -> float | None:
    """Mean duration of each phase's finished runs, over the runs that are not; None when none has finished yet."""
    taken: dict[str, list[float]] = defaultdict(list)
    for run in record.runs.values():
        if run.state == "done":
            seconds = read_seconds(outputs / run.run_id)
            if seconds is not None:
                taken[_phase(run)].append(seconds)
    if not taken:
        return None
    means = {phase: sum(values) / len(values) for phase, values in taken.items()}
    overall = sum(means.values()) / len(means)
    running = [run for run in record.runs.values() if run.state == "running"]
    waiting = [run for run in record.runs.values() if run.state == "waiting"]
    now = time.time()
    work = sum(means.get(_phase(run), overall) for run in waiting) + overall * _unchosen(record)
    work += sum(max(0.0, means.get(_phase(run), overall) - (now - (run.started or now))) for run in running)
    return work / max(workers, len(running), 1)


def duration(seconds: float) -> str:
    """As people say it: 45 s, 12 min, 3 h 05 min."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


def _unchosen(record: SweepRecord) -> int:
    """Trials of a search whose values have not been chosen yet."""
    if not record.sweep.is_search:
        return 0
    sources = {run.needs for run in record.runs.values()}
    return max(0, record.sweep.trials - sum(run.run_id not in sources for run in record.runs.values()))


def _phase(run: RunState) -> str:
    return run.run_id.rpartition("-")[0]  # <model>-<phase>-<scale>
