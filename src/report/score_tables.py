"""Runs into Markdown: one row per experiment, mean and spread over seeds."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import dataclass, replace

from src.report.escaping import as_code
from src.report.metric_names import DETECTION, METRICS, RANGES, SPEEDS, Metric
from src.report.results import RunResult

CAR_AP = METRICS["classes.car.AP"]
BY_RANGE = [METRICS[f"ranges.{name}.mAP"] for name in RANGES]
BY_SPEED = [METRICS[f"speeds.{name}.mAP_present"] for name in SPEEDS]
CAR_BY_SPEED = [METRICS[f"speeds.{name}.car.AP"] for name in SPEEDS]
ERROR_BY_SPEED = [METRICS[f"speeds.{name}.mAVE_present"] for name in SPEEDS]
CAR_ERROR_BY_SPEED = [METRICS[f"speeds.{name}.car.AVE"] for name in SPEEDS]
SUMMARY = [METRICS["mAP"], METRICS["NDS"], CAR_AP, *BY_RANGE]
SUMMARY_WITH_VELOCITY = [*SUMMARY[:2], replace(METRICS["mAVE"], title="mAVE, m/s"), *SUMMARY[2:]]


@dataclass
class Experiment:
    """Runs that differ in their seed only, by seed."""

    label: str
    runs: list[RunResult]

    @property
    def key(self) -> tuple[str, ...]:
        """The phase and the settings."""
        return (self.runs[0].phase, *self.runs[0].settings)

    def values(self, metric: str) -> list[float]:
        """The metric of each run; empty unless every run has it, as means over different seeds do not compare."""
        found = [run.metrics.get(metric) for run in self.runs]
        return [] if None in found else found


def metrics_of(run: RunResult) -> list[Metric]:
    """What may be shown of a run: detection's metrics, or its own task's."""
    return [METRICS.get(name, Metric(name, name)) for name in (METRICS if run.task == DETECTION else run.metrics)]


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


def mean_and_spread(values: list[float], column: Metric) -> tuple[float, float] | None:
    """Mean and standard deviation (0 for one value) as the column states them; None of no values."""
    if not values:
        return None
    scaled = [column.scale * value for value in values]
    return statistics.mean(scaled), statistics.stdev(scaled) if len(scaled) > 1 else 0.0


def score_table(experiments: list[Experiment], columns: list[Metric]) -> str:
    """Mean ± standard deviation over seeds, the best mean of a column in bold, a dash where a run lacks the number."""
    values = [[experiment.values(column.name) for column in columns] for experiment in experiments]
    cells = [[_cell(found, column) for found, column in zip(row, columns, strict=True)] for row in values]
    for place, column in enumerate(columns):
        means = {line: statistics.mean(row[place]) for line, row in enumerate(values) if row[place]}
        if len(experiments) == 1 or not means:
            continue
        for line, mean in means.items():
            if mean == (max if column.higher_is_better else min)(means.values()):
                cells[line][place] = f"**{cells[line][place]}**"
    titles = [column.title for column in columns]
    return _markdown("experiment", titles, [experiment.label for experiment in experiments], cells)


def class_table(experiments: list[Experiment]) -> str:
    """AP by class."""
    found = [METRICS[name] for name in experiments[0].runs[0].metrics if name in METRICS]
    aps = [metric for metric in found if metric.name.startswith("classes.") and metric.name.endswith(".AP")]
    return score_table(experiments, [replace(metric, title=metric.name.split(".")[1]) for metric in aps])


def cost_table(experiments: list[Experiment], epochs: bool = False) -> str:
    """What the runs cost: of their own phase, the slowest run's time and the largest run's memory."""
    titles = ["seeds", *(["epochs"] if epochs else []), "parameters", "time, s", "peak memory, MiB"]
    cells = []
    for experiment in experiments:
        runs = experiment.runs
        slowest, largest = max(run.seconds["all"] for run in runs), max(run.peak_memory_mib["process"] for run in runs)
        row = [", ".join(str(run.seed) for run in runs), *([str(runs[0].epochs)] if epochs else [])]
        cells.append([*row, f"{runs[0].parameters / 1e6:.2f} M", f"{slowest:.0f}", str(largest)])
    return _markdown("experiment", titles, [experiment.label for experiment in experiments], cells)


def gain_table(subject: Experiment, others: list[Experiment], columns: list[Metric]) -> str:
    """What `subject` gains over each of `others`: the difference of runs of the same seed, mean ± deviation.

    Positive is more, so a gain in an error is negative. A dash where no seed has both numbers; a seed that only one of
    them has does not count.
    """
    by_seed = {run.seed: run for run in subject.runs}
    cells = []
    for other in others:
        pairs = [(by_seed[run.seed].metrics, run.metrics) for run in other.runs if run.seed in by_seed]
        row = []
        for column in columns:
            both = [(a.get(column.name), b.get(column.name)) for a, b in pairs]
            differences = [a - b for a, b in both if a is not None and b is not None]
            row.append(_cell(differences, column, signed=True))
        cells.append([str(len(pairs)), *row])
    titles = ["seeds", *(column.title for column in columns)]
    return _markdown(f"{subject.label} over", titles, [other.label for other in others], cells)


def _cell(values: list[float], column: Metric, signed: bool = False) -> str:
    found = mean_and_spread(values, column)
    if found is None:
        return "-"
    text = f"{found[0]:{'+' if signed else ''}.{column.digits}f}"
    return text + (f" ± {found[1]:.{column.digits}f}" if len(values) > 1 else "")


def _markdown(corner: str, titles: list[str], labels: list[str], cells: list[list[str]]) -> str:
    lines = [f"| {corner} | {' | '.join(titles)} |", "|---" * (1 + len(titles)) + "|"]
    lines += [f"| {label} | {' | '.join(row)} |" for label, row in zip(labels, cells, strict=True)]
    return "\n".join(lines)
