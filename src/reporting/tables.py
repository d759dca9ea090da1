"""Runs into Markdown: one row per experiment, mean and spread over seeds."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import dataclass

from src.reporting.results import RunResult

RANGES = ("0-25", "25-50", "50-100", "100-150")
SPEEDS = ("0-0.5", "0.5-10", "10-25", "25+")


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


@dataclass(frozen=True)
class Column:
    """One metric of a table."""

    title: str
    metric: str  # as in RunResult.metrics
    scale: float = 100.0  # fractions of 1 in percent
    digits: int = 1
    best: Callable[[list[float]], float] = max


CAR_AP = Column("car AP", "classes.car.AP")
BY_RANGE = [Column(f"mAP {name} m", f"ranges.{name}.mAP") for name in RANGES]
BY_SPEED = [Column(f"mAP {name} m/s", f"speeds.{name}.mAP_present") for name in SPEEDS]
CAR_BY_SPEED = [Column(f"car AP {name} m/s", f"speeds.{name}.car.AP") for name in SPEEDS]
ERROR_BY_SPEED = [Column(f"mAVE {name} m/s", f"speeds.{name}.mAVE_present", 1.0, 2, min) for name in SPEEDS]
CAR_ERROR_BY_SPEED = [Column(f"car AVE {name} m/s", f"speeds.{name}.car.AVE", 1.0, 2, min) for name in SPEEDS]
SUMMARY = [Column("mAP", "mAP"), Column("NDS", "NDS"), CAR_AP, *BY_RANGE]
SUMMARY_WITH_VELOCITY = [*SUMMARY[:2], Column("mAVE, m/s", "mAVE", 1.0, 2, min), *SUMMARY[2:]]


def group_runs(runs: list[RunResult], name_of: Callable[[RunResult], str | None]) -> list[Experiment]:
    """Runs by phase and settings, best mAP first; `name_of` names known ones, others show their overrides.

    Raises ValueError when the runs are of different data.
    """
    if len({run.data for run in runs}) > 1:
        raise ValueError(f"a table never mixes data, but these runs used {sorted({run.data for run in runs})}")
    groups: dict[tuple[str, ...], list[RunResult]] = {}
    for run in sorted(runs, key=lambda run: run.seed):
        groups.setdefault((run.phase, *run.settings), []).append(run)
    experiments = []
    for group in sorted(groups.values(), key=lambda group: -statistics.mean(run.metrics["mAP"] for run in group)):
        label = name_of(group[0]) or f"`{' '.join(group[0].settings) or 'defaults'}`"
        experiments.append(Experiment(label, group))
    labels = [experiment.label for experiment in experiments]
    for experiment in experiments:
        if labels.count(experiment.label) > 1:
            experiment.label += f" (`{' '.join(experiment.runs[0].settings)}`)"
    return experiments


def mean_and_spread(values: list[float], column: Column) -> tuple[float, float] | None:
    """Mean and standard deviation (0 for one value) as the column states them; None of no values."""
    if not values:
        return None
    scaled = [column.scale * value for value in values]
    return statistics.mean(scaled), statistics.stdev(scaled) if len(scaled) > 1 else 0.0


def score_table(experiments: list[Experiment], columns: list[Column]) -> str:
    """Mean ± standard deviation over seeds, the best mean of a column in bold, a dash where a run lacks the number."""
    values = [[experiment.values(column.metric) for column in columns] for experiment in experiments]
    cells = [[_cell(found, column) for found, column in zip(row, columns, strict=True)] for row in values]
    for place, column in enumerate(columns):
        means = {line: statistics.mean(row[place]) for line, row in enumerate(values) if row[place]}
        if len(experiments) == 1 or not means:
            continue
        for line, mean in means.items():
            if mean == column.best(list(means.values())):
                cells[line][place] = f"**{cells[line][place]}**"
    return _markdown("experiment", columns, [experiment.label for experiment in experiments], cells)


def class_table(experiments: list[Experiment]) -> str:
    """AP by class."""
    names = [name for name in experiments[0].runs[0].metrics if name.startswith("classes.")]
    return score_table(experiments, [Column(name.split(".")[1], name) for name in names])


def cost_table(experiments: list[Experiment], epochs: bool = False) -> str:
    """What the runs cost: of their own phase, the slowest run's time and the largest run's memory."""
    text = f"| experiment | seeds |{' epochs |' if epochs else ''} parameters | time, s | peak memory, MiB |\n"
    text += "|---" * (6 if epochs else 5) + "|"
    for experiment in experiments:
        runs = experiment.runs
        seeds = ", ".join(str(run.seed) for run in runs)
        slowest, largest = max(run.seconds for run in runs), max(run.peak_memory_mib for run in runs)
        text += f"\n| {experiment.label} | {seeds} |" + (f" {runs[0].epochs} |" if epochs else "")
        text += f" {runs[0].parameters / 1e6:.2f} M | {slowest:.0f} | {largest} |"
    return text


def gain_table(subject: Experiment, others: list[Experiment], columns: list[Column]) -> str:
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
            both = [(a.get(column.metric), b.get(column.metric)) for a, b in pairs]
            differences = [a - b for a, b in both if a is not None and b is not None]
            row.append(_cell(differences, column, signed=True))
        cells.append([str(len(pairs)), *row])
    titles = [Column("seeds", ""), *columns]
    return _markdown(f"{subject.label} over", titles, [other.label for other in others], cells)


def _cell(values: list[float], column: Column, signed: bool = False) -> str:
    found = mean_and_spread(values, column)
    if found is None:
        return "-"
    text = f"{found[0]:{'+' if signed else ''}.{column.digits}f}"
    return text + (f" ± {found[1]:.{column.digits}f}" if len(values) > 1 else "")


def _markdown(corner: str, columns: list[Column], labels: list[str], cells: list[list[str]]) -> str:
    lines = [f"| {corner} | {' | '.join(column.title for column in columns)} |", "|---" * (1 + len(columns)) + "|"]
    lines += [f"| {label} | {' | '.join(row)} |" for label, row in zip(labels, cells, strict=True)]
    return "\n".join(lines)
