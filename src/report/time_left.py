"""How far a sweep is, the time that it still needs, and durations as people say them."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection

from src.report.sweep_record import RunState, SweepRecord
from src.training.identity import key_of


def progress_of(record: SweepRecord, workers: int, now: float) -> str:
    """`progress_line` of a sweep."""
    return progress_line(record.study, record.runs.values(), workers, now, record.unchosen)


def progress_line(name: str, runs: Collection[RunState], workers: int, now: float, unchosen: int = 0) -> str:
    """Done, running, left, failed, and the time left as far as finished runs of the same phase tell it.

    `unchosen` are trials of a search that are no runs yet.
    """
    count = Counter(run.state for run in runs)
    left = count["waiting"] + unchosen
    words = [f"{count['done']} of {len(runs) + unchosen} done", f"{count['running']} running", f"{left} left"]
    words += [f"{count[state]} {state}" for state in ("failed", "pruned") if count[state]]
    if left or count["running"]:
        seconds = seconds_left(runs, workers, now, unchosen)
        words.append("time left unknown yet" if seconds is None else f"about {duration(seconds)} left")
    return f"{name}: {', '.join(words)}"


def seconds_left(runs: Collection[RunState], workers: int, now: float, unchosen: int = 0) -> float | None:
    """Seconds until all runs end, at the mean duration of the finished ones of as many epochs of their phase; None
    before any has finished."""
    of_phase: dict[tuple[str, ...], list[float]] = defaultdict(list)
    for run in runs:
        if run.state == "done" and run.started is not None and run.ended is not None:
            of_phase[_phase(run)].append(max(0.0, run.ended - run.started))
    if not of_phase:
        return None
    means = {phase: sum(values) / len(values) for phase, values in of_phase.items()}
    overall = sum(means.values()) / len(means)
    running = [run for run in runs if run.state == "running"]
    waiting = [run for run in runs if run.state == "waiting"]
    work = sum(means.get(_phase(run), overall) for run in waiting) + overall * unchosen
    for run in running:
        elapsed = max(0.0, now - (run.started or now))  # a clock that was set back says less than nothing
        work += max(0.0, means.get(_phase(run), overall) - elapsed)
    return work / max(workers, len(running), 1)


def duration(seconds: float) -> str:
    """`41 s`, `12 min`, `3 h 05 min`, `2 d 4 h`."""
    if round(seconds) < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    if minutes < 90:
        return f"{minutes} min"
    if minutes < 48 * 60:
        return f"{minutes // 60} h {minutes % 60:02d} min"
    return f"{minutes // 1440} d {minutes % 1440 // 60} h"


def _phase(run: RunState) -> tuple[str, ...]:
    """Model, phase and scale, and the epochs if they are not those of the phase: 0 of what is only scored."""
    return run.run_id.rpartition("-")[0], *(one for one in run.overrides if key_of(one) == "phase.epochs")
