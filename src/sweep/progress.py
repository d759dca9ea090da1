"""The progress of a sweep in a line."""

from __future__ import annotations

import time
from pathlib import Path

from src.report.sweep_record import SweepRecord
from src.report.time_left import duration, seconds_left
from src.sweep.run_status import read_seconds


def progress_line(record: SweepRecord, outputs: Path, workers: int) -> str:
    """Done, running, left, failed, and the time left as far as finished runs of the same phase tell it."""
    left = record.count("waiting") + record.unchosen
    words = [f"{record.count('done')} of {record.planned} done", f"{record.count('running')} running", f"{left} left"]
    words += [f"{record.count(state)} {state}" for state in ("failed", "pruned") if record.count(state)]
    if left or record.count("running"):
        taken = {run_id: read_seconds(outputs / run_id) for run_id, run in record.runs.items() if run.state == "done"}
        known = {run_id: seconds for run_id, seconds in taken.items() if seconds is not None}
        seconds = seconds_left(record, known, workers, time.time())
        words.append("time left unknown yet" if seconds is None else f"about {duration(seconds)} left")
    return f"{record.study}: {', '.join(words)}"
