"""Runs into Markdown: one row per experiment, means over seeds with intervals over scenes."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from src.report.comparisons import compare
from src.report.escaping import as_code, markdown_table
from src.report.metric_names import DETECTION, FORECASTS, LONG_RANGES, METRICS, RANGES, SPEEDS, Metric, metric_of
from src.report.results import RunResult
from src.report.sweep_file import MAX_COLUMNS
from src.report.sweep_table import MISSING, format_score

CAR_AP = METRICS["classes.car.AP"]
BY_RANGE = [METRICS[f"ranges.{name}.mAP"] for name in RANGES]
BY_LONG_RANGE = [METRICS[f"long_range.{name}"] for name in ("mAP", "NDS")]
BY_LONG_RANGE += [METRICS[f"long_range.ranges.{name}.mAP"] for name in LONG_RANGES]
BY_SPEED = [METRICS[f"speeds.{name}.mAP_present"] for name in SPEEDS]
NORMALIZED_BY_SPEED = [METRICS[f"speeds.{name}.mAP_normalized"] for name in SPEEDS]
CAR_BY_SPEED = [METRICS[f"speeds.{name}.car.AP"] for name in SPEEDS]
ERROR_BY_SPEED = [METRICS[f"speeds.{name}.mAVE_present"] for name in SPEEDS]
CAR_ERROR_BY_SPEED = [METRICS[f"speeds.{name}.car.AVE"] for name in SPEEDS]
SUMMARY = [METRICS["mAP"], METRICS["NDS"], METRICS["mAVE"], CAR_AP, METRICS["measures.moving_AP"]]
OF_MEMORY = [METRICS[f"measures.{name}"] for name in ("hidden_recall", "occupied_share", "remembered_share")]
OF_HISTORY = [METRICS[f"measures.history_{name}"] for name in ("near", "faint", "velocity_error")]


@dataclass
class Experiment:
    """Runs that differ in their seed only, by seed."""

    label: str
    runs: list[RunResult]

    @property
    def key(self) -> tuple[str, ...]:
        """The phase and the settings."""
        return (self.runs[0].phase, *self.runs[0].settings)

    def values(self, column: Metric) -> dict[int, float]:
        """The column's number by seed; empty unless every run has it: means over other seeds do not compare."""
        found = {run.seed: run.metrics.get(column.name) for run in self.runs}
        return {} if None in found.values() else {seed: column.scale * value for seed, value in found.items()}


def metrics_of(run: RunResult) -> list[Metric]:
    """What may be shown of a run: detection's metrics, or its own task's; of a world model's those that have a name."""
    if run.task == DETECTION:
        return list(METRICS.values())
    named = [metric for name, metric in FORECASTS.items() if name in run.metrics]
    return named or [metric_of(name) for name in run.metrics]


def group_runs(runs: list[RunResult], name_of: Callable[[RunResult], str | None]) -> list[Experiment]:
    """Runs of one task by phase and settings, best headline number first.

    `name_of` names known ones, others show their overrides. Raises ValueError when the runs are of different data.
    """
    data = {run.dataset for run in runs}
    if len(data) > 1:
        raise ValueError(f"a table never mixes data, but these runs used {sorted(data)}")
    groups: dict[tuple[str, ...], list[RunResult]] = {}
    for run in sorted(runs, key=lambda run: run.seed):
        groups.setdefault((run.phase, *run.settings), []).append(run)
    experiments = []

    def headline(group: list[RunResult]) -> float:
        return statistics.mean(run.metrics[run.headline] for run in group)

    for group in sorted(groups.values(), key=headline, reverse=True):
        label = name_of(group[0]) or as_code(group[0].settings or ("defaults",))
        experiments.append(Experiment(label, group))
    labels = [experiment.label for experiment in experiments]
    for experiment in experiments:
        if labels.count(experiment.label) > 1:
            experiment.label += f" ({as_code(experiment.runs[0].settings)})"
    return experiments


class Estimate(NamedTuple):
    """A mean over runs as a column states it, with its 95 % interval over scenes; of no length where unknown."""

    mean: float
    low: float
    high: float


def estimate(runs: Sequence[RunResult], column: Metric) -> Estimate | None:
    """Mean of a metric over the runs that have it, with its interval over scenes; None if none has it."""
    having = [run for run in runs if run.metrics.get(column.name) is not None]
    if not having:
        return None
    mean = column.scale * statistics.mean(run.metrics[column.name] for run in having)
    return Estimate(mean, *(mean_bounds(having, column) or (mean, mean)))


def mean_bounds(runs: Sequence[RunResult], column: Metric) -> tuple[float, float] | None:
    """95 % interval over scenes of runs' mean as the column states it, the mean of their bounds; None unless each run
    has one."""
    bounds = [run.intervals.get(column.name) for run in runs]
    if not bounds or None in bounds:
        return None
    low, high = (column.scale * statistics.mean(ends) for ends in zip(*bounds, strict=True))
    return low, high


def score_table(experiments: list[Experiment], columns: list[Metric]) -> str:
    """Mean over seeds with its interval over scenes; bold is decided against every other row.

    A dash stands where a run lacks the number. Wide tables are cut, and what no run has is left out.
    """
    known = [column for column in columns if any(experiment.values(column) for experiment in experiments)]
    parts = -(-len(known) // (MAX_COLUMNS - 1))
    cut = [known[round(k * len(known) / parts) : round((k + 1) * len(known) / parts)] for k in range(parts)]
    return "\n\n".join(
        markdown_table(["experiment", *(column.heading for column in some)], _score_lines(experiments, some))
        for some in cut
    )


def _score_lines(experiments: list[Experiment], columns: list[Metric]) -> list[list[str]]:
    lines = [[experiment.label] for experiment in experiments]
    for column in columns:
        values = [experiment.values(column) for experiment in experiments]
        for line, experiment, own in zip(lines, experiments, values, strict=True):
            if not own:
                line.append(MISSING)
                continue
            text = format_score(statistics.mean(own.values()), mean_bounds(experiment.runs, column), column)
            others = [compare(own, other, column.digits) for other in values if other and other is not own]
            best = bool(others) and all(found is not None and found.favours(column) for found in others)
            line.append(f"**{text}**" if best else text)
    return lines


def class_table(experiments: list[Experiment]) -> str:
    """AP by class."""
    found = [METRICS[name] for name in experiments[0].runs[0].metrics if name in METRICS]
    aps = [metric for metric in found if metric.name.startswith("classes.") and metric.name.endswith(".AP")]
    return score_table(experiments, [replace(metric, title=metric.name.split(".")[1]) for metric in aps])


def cost_table(experiments: list[Experiment], epochs: bool = False) -> str:
    """What the runs cost: of their own phase, the slowest run's time as far as known and the largest run's memory."""
    titles = ["experiment", "seeds", *(["epochs"] if epochs else []), "parameters", "time, s", "peak memory, MiB"]
    lines = []
    for experiment in experiments:
        runs = experiment.runs
        times = [run.training_s for run in runs if run.training_s is not None]
        largest = max(run.peak_memory_mib["process"] for run in runs)
        row = [experiment.label, ", ".join(str(run.seed) for run in runs), *([str(runs[0].epochs)] if epochs else [])]
        slowest = f"{max(times):.0f}" if times else MISSING
        lines.append([*row, f"{runs[0].parameters / 1e6:.2f} M", slowest, str(largest)])
    return markdown_table(titles, lines)


def gain_table(subject: Experiment, others: list[Experiment], columns: list[Metric]) -> str:
    """What `subject` has more than each of `others`: differences of runs of the same seed, see `Comparison.text`.

    A dash where no seed has both numbers; a seed that only one of them has does not count.
    """
    seeds = {run.seed for run in subject.runs}
    known = [column for column in columns if subject.values(column)]
    lines = []
    for other in others:
        found = [compare(subject.values(column), other.values(column), column.digits) for column in known]
        pairs = sum(run.seed in seeds for run in other.runs)
        lines.append([other.label, str(pairs), *(MISSING if gain is None else gain.text for gain in found)])
    titles = [f"{subject.label} over", "seeds", *(column.heading for column in known)]
    return markdown_table(titles, lines) if known else ""
