"""The figures of sweeps and runs: which numbers go into which chart."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from markupsafe import Markup

from src.dashboard.board import Board, Run, Sweep
from src.dashboard.charts import Bars, ChartPoint, Series, category_chart, line_chart, nice_ticks
from src.report.metric_names import RANGES, SPEEDS, find_metric
from src.report.results import RunResult
from src.report.score_tables import Estimate, estimate
from src.report.sweep_file import PlotConfig
from src.report.sweep_table import PAPER, format_here, format_paper, format_score
from src.structures.taxonomy import CLASSES

CURVES = (
    ("val/mAP", "mAP while training", "mAP, %", 100.0),
    ("val/NDS", "NDS while training", "NDS, %", 100.0),
    ("loss/total", "Training loss", "loss", 1.0),
    ("step/total", "Training loss by step", "loss", 1.0),
)
Curves = dict[str, Sequence[tuple[float, float]]]
LATENCY, ACCURACY = "latency.total", "NDS"


def sweep_figures(board: Board, sweep: Sweep) -> dict[str, list[Markup]]:
    """The figures of a sweep by section, sections in order; empty ones are left out."""
    results, plots = results_by_row(board, sweep), sweep.record.sweep.plots
    curves = {label: board_curves(board, runs) for label, runs in _runs_by_row(board, sweep).items()}
    sections = {
        "Metric against knob": [figure for plot in plots for figure in knob_figures(sweep, plot, results)],
        "Search": search_figures(sweep),
        "Latency against accuracy": latency_figures(sweep, results),
        "By distance, speed and class": distance_figures(results) + class_figures(results),
        "Learning curves": curve_figures(curves),
    }  # fmt: skip
    return {title: figures for title, figures in sections.items() if figures}


def knob_figures(sweep: Sweep, plot: PlotConfig, results: dict[str, list[RunResult]]) -> list[Markup]:
    """A plot's metric as measured here, and the paper's beside it; never on one axis, the data are not the same.

    Both vertical axes have the same length, so that steps compare. Bars where the rows have no place on an axis.
    """
    metric = find_metric(plot.metric, sweep.key, sweep.record.sweep.task)
    rows = sweep.record.sweep.rows
    labels = [row.label for row in rows]
    here = {label: estimate(results.get(label, ()), metric) for label in labels}
    stated = {row.label: row.paper.get(metric.name) for row in rows}
    paper = {label: None if value is None else Estimate(value, value, value) for label, value in stated.items()}
    known = any(found is not None and found.high > found.low for found in here.values())
    sides = {
        f"{metric.title} here, scale {sweep.record.scale}{', with 95 % intervals over scenes' if known else ''}": here
    }
    if any(value is not None for value in stated.values()):
        sides[f"{metric.title} in the paper, TruckScenes"] = paper
    if any(row.x is None for row in rows):
        return [
            category_chart(
                title, labels, [Bars(label="", values=list(side.values()), style=style)], metric.heading, metric.digits
            )
            for style, (title, side) in enumerate(sides.items())
        ]
    ordered = sorted(rows, key=lambda row: row.x)
    series = []
    for style, side in enumerate(sides.values()):
        points = [
            ChartPoint(row.x, found.mean, _bounds(found),
                       f"{row.label}: {format_score(found.mean, _bounds(found), metric)}")
            for row in ordered if (found := side[row.label]) is not None
        ]  # fmt: skip
        series.append(Series(label="", points=points, style=style))
    ends = [[end for point in one.points for end in (point.y, *(point.bounds or ()))] for one in series]
    span = max((max(values) - min(values) for values in ends if values), default=0.0)
    ticks = list({row.x: f"{row.x:g}" for row in ordered}.items())
    charts = zip(sides, series, strict=True)
    return [line_chart(t, [one], plot.label, metric.heading, x_ticks=ticks, y_span=span or None) for t, one in charts]


def search_figures(sweep: Sweep) -> list[Markup]:
    """A search's objective by trial with the best so far, and over every number it chose; none for other sweeps."""
    search = sweep.record.sweep
    tried = [run for run in sweep.record.runs.values() if run.value is not None] if search.is_search else []
    if not tried:
        return []
    metric = find_metric(search.objective, sweep.key, search.task)
    tried.sort(key=lambda run: run.ended or 0.0)
    values = [run.value * metric.scale for run in tried]
    by_trial = [ChartPoint(place, value, None, tried[place - 1].label) for place, value in enumerate(values, start=1)]
    trials = Series(label="trial", points=by_trial, joined=False)
    best = [ChartPoint(place, max(values[:place])) for place in range(1, len(values) + 1)]
    so_far = Series(label="best so far", points=best, style=1)
    ticks = [(mark, f"{mark:g}") for mark in nice_ticks(1, len(tried)) if mark == round(mark)]
    figures = [line_chart(f"{metric.title} by trial", [trials, so_far], "trial", metric.title, x_ticks=ticks)]
    for key, dimension in search.space.items():
        if dimension.choices is None:
            settings = (dict(part.lstrip("+").split("=", 1) for part in run.overrides if "=" in part) for run in tried)
            points = [
                ChartPoint(float(of[key]), value)
                for of, value in zip(settings, values, strict=True)
                if _number(of.get(key))
            ]
            dots = Series(label="", points=points, joined=False)
            figures.append(line_chart(f"{metric.title} by {key}", [dots], key, metric.title, log_x=dimension.log))
    return figures


def latency_figures(sweep: Sweep, results: dict[str, list[RunResult]]) -> list[Markup]:
    """NDS over milliseconds per frame, one point for each row that was timed, where at least two were."""
    accuracy, latency = find_metric(ACCURACY, sweep.key), find_metric(LATENCY, sweep.key)
    points = []
    for style, (label, runs) in enumerate(results.items()):
        score, time = estimate(runs, accuracy), estimate(runs, latency)
        if score is not None and time is not None:
            note = f"{label}: {time.mean:.1f} ms, {score.mean:.1f} {accuracy.title}"
            point = ChartPoint(time.mean, score.mean, _bounds(score), note)
            points.append(Series(label=label, points=[point], style=style, joined=False))
    if len(points) < 2:
        return []
    return [line_chart(f"{ACCURACY} over latency", points, "milliseconds per frame", f"{ACCURACY}, %")]


def distance_figures(results: dict[str, list[RunResult]]) -> list[Markup]:
    """mAP by distance and, where it was scored, by speed: a line for each row."""
    figures = []
    for title, parts, name, axis in (
        ("mAP by distance", RANGES, "ranges.{}.mAP", "distance, m"),
        ("mAP by speed", SPEEDS, "speeds.{}.mAP_present", "speed of the ground truth, m/s"),
        ("Normalised mAP by speed", SPEEDS, "speeds.{}.mAP_normalized", "speed of the ground truth, m/s"),
    ):
        lines = []
        for style, (label, runs) in enumerate(results.items()):
            metrics = [find_metric(name.format(part), title) for part in parts]
            points = [
                ChartPoint(float(place), found.mean, None, f"{label}, {parts[place]} {axis.rpartition(' ')[2]}: "
                           + format_score(found.mean, _bounds(found), metric))
                for place, metric in enumerate(metrics) if (found := estimate(runs, metric)) is not None
            ]  # fmt: skip
            if points:
                lines.append(Series(label=label, points=points, style=style))
        if lines:
            ticks = [(float(place), part) for place, part in enumerate(parts)]
            figures.append(line_chart(title, lines, axis, "mAP, %", x_ticks=ticks))
    return figures


def class_figures(results: dict[str, list[RunResult]]) -> list[Markup]:
    """AP by class: bars with numbers for one or two, dots for more."""
    rows = []
    for style, (label, runs) in enumerate(results.items()):
        found = [estimate(runs, find_metric(f"classes.{name}.AP", "by class")) for name in CLASSES]
        if any(value is not None for value in found):
            rows.append(Bars(label=label, values=found, style=style))
    names = [name.replace("_", " ") for name in CLASSES]
    return [category_chart("AP by class", names, rows, "AP, %", dots=len(rows) > 2)] if rows else []


def curve_figures(of_row: dict[str, list[Curves]]) -> list[Markup]:
    """Scores and loss over steps: a line for each run, runs of one row alike."""
    names = {name for runs in of_row.values() for run in runs for name in run}
    has_epochs = "loss/total" in names
    scores = [name.removeprefix("val/") for name in sorted(names) if name.startswith("val/")]
    of_task = [] if {"mAP", "NDS"} & set(scores) else scores
    figures = []
    for name, title, words, scale in (*((f"val/{s}", f"{s} while training", s, 1.0) for s in of_task), *CURVES):
        if name == "step/total" and has_epochs:
            continue
        lines = [
            Series(label=label, points=[ChartPoint(x, y * scale) for x, y in run[name]], style=style)
            for style, (label, runs) in enumerate(of_row.items())
            for run in runs
            if run.get(name)
        ]
        if lines:
            few = max(len(line.points) for line in lines) <= 12
            figures.append(line_chart(title, lines, "steps", words, markers=few))
    return figures


def run_figures(board: Board, runs: dict[str, Run]) -> dict[str, list[Markup]]:
    """The figures of a run, or of runs side by side, by section."""
    results = {label: [run.result] for label, run in runs.items() if run.result is not None}
    curves = {label: board_curves(board, [run]) for label, run in runs.items()}
    losses = [figure for found in curves.values() for of_run in found for figure in loss_figures(of_run)]
    sections = {
        "Learning curves": curve_figures(curves),
        "By distance, speed and class": distance_figures(results) + class_figures(results),
        "Losses": losses if len(runs) == 1 else [],
    }
    return {title: figures for title, figures in sections.items() if figures}


def loss_figures(curves: Curves) -> list[Markup]:
    """Every loss term of one run, as it stands in the total."""
    terms = [(name, points) for name, points in curves.items() if name.startswith("loss/") and name != "loss/total"]
    lines = [
        Series(
            label=name.removeprefix("loss/").replace("_", " "),
            points=[ChartPoint(*point) for point in points],
            style=style,
        )
        for style, (name, points) in enumerate(terms)
    ]
    return [line_chart("Loss terms", lines, "steps", "loss", markers=False)] if lines else []


def board_curves(board: Board, runs: Iterable[Run]) -> list[Curves]:
    """Learning curves of runs that have any: from the result, or from the folder of one that still trains."""
    found = (run.result.curves if run.result is not None else board.folders.curves(run.run_id) for run in runs)
    return [curves for curves in found if curves]


def _runs_by_row(board: Board, sweep: Sweep) -> dict[str, list[Run]]:
    rows = sweep.record.rows
    return {label: [board.runs[run] for run in seeds.values() if run in board.runs] for label, seeds in rows.items()}


def results_by_row(board: Board, sweep: Sweep) -> dict[str, list[RunResult]]:
    rows = _runs_by_row(board, sweep)
    return {label: [run.result for run in runs if run.result is not None] for label, runs in rows.items()}


def _bounds(found: Estimate) -> tuple[float, float] | None:
    return (found.low, found.high) if found.high > found.low else None


def headline(sweep: Sweep) -> str:
    """The row that is decided against all others here by the sweep's first metric, and the paper's best; nothing before
    there are numbers."""
    table = next(iter(sweep.tables), None)
    if table is None or not table.columns:
        return ""
    metric, rows = table.columns[0], [(row, row.cells[0]) for row in table.rows]
    here = [(row, cell) for row, cell in rows if cell.mean is not None]
    if not here:
        return ""
    best = [f"{row.label}, {format_here(cell, metric, row.done)}" for row, cell in here if cell.best]
    if len(here) == 1:
        best = [f"{here[0][0].label}, {format_here(here[0][1], metric, here[0][0].done)}"]
    line = f"Best {metric.title} here: {best[0] if best else 'undecided'}"
    paper = [(cell.paper, row.label) for row, cell in rows if cell.paper is not None and row.state != PAPER]
    if paper:
        value, label = (max if metric.higher_is_better else min)(paper)
        line += f". In the paper: {label}, {format_paper(value, metric)}"
    return line + "."


def _number(text: str | None) -> bool:
    try:
        float(text)
    except (TypeError, ValueError):
        return False
    return True
