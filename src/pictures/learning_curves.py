"""Training curves over epochs, and bars of AP by class and of mAP by distance."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullLocator

from src.errors import DataError
from src.pictures.canvas import SHEET_PX, Canvas
from src.pictures.contents import CLASS_COLOURS, INK, MUTED

Array = np.ndarray
Series = dict[str, tuple[Array, Array]]  # name -> epochs [E], values [E]

LINE_COLOURS = ("#0072B2", "#D55E00", "#00846B", "#8C2D7E", "#E6A000", "#3DA5D9", "#6B3E1E", "#E7298A", "#4B3BB5")
LINE_DASHES = ("-", (0, (5, 1.6)), (0, (1.4, 1.4)))
HEIGHT_PX = 520
MAX_EPOCHS, LARGEST = 1e6, 1e15
"""A row or a value beyond them is damage and left out."""


def read_metrics(
    path: Path | str,
) -> Series:
    """Columns of a CSV log with an `epoch` column, averaged within each epoch; blank or non-finite values are left out.

    Raises DataError when the file has no `epoch` column or holds something else than numbers.
    """
    path = Path(path)
    try:
        with path.open(newline="") as stream:
            rows = list(csv.DictReader(stream))
    except (OSError, ValueError, csv.Error) as error:
        raise DataError(f"{path}: not a readable CSV log ({type(error).__name__}: {error})") from error
    if not rows or "epoch" not in rows[0]:
        raise DataError(f"{path}: must be a CSV log with a column `epoch` and at least one row")
    values: dict[str, dict[int, list[float]]] = {}
    for number, row in enumerate(rows, start=2):
        try:
            numbers = {name: float(text) for name, text in row.items() if name and text}
        except (TypeError, ValueError) as error:
            raise DataError(f"{path}, line {number}: every cell must be a number or blank ({error})") from error
        if not 0 <= (epoch := numbers.pop("epoch", np.nan)) < MAX_EPOCHS:
            continue
        for name, value in numbers.items():
            if name != "step" and abs(value) <= LARGEST:
                values.setdefault(name, {}).setdefault(int(epoch), []).append(value)
    return {
        name: (np.array(sorted(by_epoch)), np.array([np.mean(by_epoch[epoch]) for epoch in sorted(by_epoch)]))
        for name, by_epoch in values.items()
    }


def style_axes(axes: Axes, title: str) -> None:
    """Quiet frame: light grid, no box, title at the left."""
    axes.set_title(title, loc="left", fontsize=11, fontweight="bold", color=INK, parse_math=False)
    axes.grid(axis="y", color="#E3E6EA", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(colors="#495057", labelsize=9, length=0)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
    axes.spines["bottom"].set_color("#C9CED4")


def paint_lines(axes: Axes, series: Series) -> None:
    """One line per series with a legend at the right, highest last value first."""
    for index, name in enumerate(sorted(series, key=lambda name: -series[name][1][-1])):
        epochs, values = series[name]
        label = f"{name.replace('$', chr(92) + '$')}  {values[-1]:.3g}"  # legends would read $ as a formula
        dashes = LINE_DASHES[index // len(LINE_COLOURS) % len(LINE_DASHES)]
        colour = LINE_COLOURS[index % len(LINE_COLOURS)]
        style = {"color": colour, "linestyle": dashes, "linewidth": 1.8, "marker": "o", "markersize": 3}
        axes.plot(epochs + 1, values, label=label, **style)
    axes.set_xlabel("epoch", color="#495057", fontsize=9)
    axes.xaxis.get_major_locator().set_params(integer=True)
    if series:
        axes.legend(
            loc="upper left", bbox_to_anchor=(1.01, 1.0), borderaxespad=0, frameon=False, fontsize=8.5, labelcolor=INK
        )
    else:
        axes.text(0.5, 0.5, "nothing logged yet", transform=axes.transAxes, ha="center", color=MUTED)


def draw_curves(
    path: Path | str,
    metrics_csv: Path | str,
    title: str = "",
) -> None:
    """Write a PNG of a CSV log: every column named *loss* (left, logarithmic) and mAP and NDS (right) over epochs.

    Without mAP and NDS, all of `val/` stand at the right.
    Raises DataError when the log cannot be read as numbers by epoch.
    """
    series = read_metrics(metrics_csv)
    losses = {name: line for name, line in series.items() if "loss" in name.lower()}
    scores = {name: line for name, line in series.items() if name.split("/")[-1].lower() in ("map", "nds")}
    scores = scores or {name: line for name, line in series.items() if name.startswith("val/")}
    canvas = Canvas(SHEET_PX, HEIGHT_PX)
    canvas.text(12, 10, title, 20, bold=True)
    left = canvas.axes(70, 80, 520, HEIGHT_PX - 140)
    style_axes(left, "Loss terms")
    paint_lines(left, losses)
    if losses and all((values > 0).all() for _, values in losses.values()):
        left.set_yscale("log")
        left.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        left.yaxis.set_major_formatter("{x:g}")
        left.yaxis.set_minor_locator(NullLocator())
    right = canvas.axes(930, 80, 470, HEIGHT_PX - 140)
    style_axes(right, "Validation")
    paint_lines(right, scores)
    right.set_ylim(bottom=0)
    canvas.save(path)


def paint_bars(axes: Axes, scores: Mapping[str, float | None], colours: list[str]) -> None:
    """One bar per entry with its value in percent; None or NaN reads as `none`."""
    values = np.array([np.nan if value is None else 100 * value for value in scores.values()], dtype=np.float64)
    axes.bar(range(len(values)), np.nan_to_num(values), color=colours, width=0.72)
    axes.set_xticks(range(len(values)), [name.replace("_", "\n") for name in scores], fontsize=8.5, parse_math=False)
    for place, value in enumerate(values):
        text, shown = ("none", 0.0) if np.isnan(value) else (f"{value:.1f}", value)
        axes.annotate(text, (place, shown), (0, 3), textcoords="offset points", ha="center", fontsize=9, color=INK)
    axes.set_ylim(0, max(10.0, 1.15 * float(np.nan_to_num(values).max(initial=0))))
    axes.set_ylabel("%", color="#495057", fontsize=9, rotation=0, labelpad=10)


def draw_scores(
    path: Path | str,
    ap_by_class: Mapping[str, float | None],
    map_by_range: Mapping[str, float | None],
    title: str = "",
) -> None:
    """Write a PNG of AP by class (left) and mAP by distance (right); values are fractions of 1, None where unknown."""
    canvas = Canvas(SHEET_PX, HEIGHT_PX)
    canvas.text(12, 10, title, 20, bold=True)
    left = canvas.axes(60, 80, 980, HEIGHT_PX - 140)
    style_axes(left, "AP by class")
    paint_bars(left, ap_by_class, [CLASS_COLOURS.get(name, MUTED) for name in ap_by_class])
    right = canvas.axes(1110, 80, 470, HEIGHT_PX - 140)
    style_axes(right, "mAP by distance")
    paint_bars(right, map_by_range, ["#5B7C99"] * len(map_by_range))
    canvas.save(path)
