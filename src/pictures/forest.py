"""Effects with their intervals, one below the other, in groups; beside each the effect that was expected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from src.pictures.canvas import SHEET_PX, Canvas
from src.pictures.contents import AXIS_INK, INK, MUTED
from src.pictures.learning_curves import quiet_axes

ROW_PX = 26
HEAD_PX = 34
"""Height of a group's title."""
TOP_PX = 84
"""Height of the picture's title and keys."""
FOOT_PX = 60
"""Height of the ticks and of the axis label."""
PLOT_PX = (680, 590)
"""Where the axis begins, and its width; labels stand before it, numbers after."""
COLOURS = {"shows": "#0072B2", "does not show": "#D55E00", "undecided": "#6C757D", "not run": "#ADB5BD"}


@dataclass(frozen=True)
class ForestRow:
    """One effect."""

    label: str
    measure: str
    verdict: str  # of COLOURS
    numbers: str  # as they are read at the right
    mean: float | None
    low: float | None = None
    high: float | None = None
    expected: float | None = None
    decides: bool = True  # else it is drawn hollow and grey


@dataclass(frozen=True)
class ForestGroup:
    """Effects under one title."""

    title: str
    verdict: str
    rows: Sequence[ForestRow]


def reach(groups: Sequence[ForestGroup]) -> tuple[float, float]:
    """The axis: zero, all means and expected effects, and of intervals what is within half their span beside them."""
    rows = [row for group in groups for row in group.rows]
    marks = [0.0, *(value for row in rows for value in (row.mean, row.expected) if value is not None)]
    ends = marks + [value for row in rows for value in (row.low, row.high) if value is not None]
    span = max(marks) - min(marks) or 1.0
    low, high = max(min(ends), min(marks) - span / 2), min(max(ends), max(marks) + span / 2)
    room = 0.04 * max(high - low, span)
    return low - room, high + room


def paint_row(axes: Axes, place: float, row: ForestRow) -> None:
    """Mean, interval (an arrow where it leaves the axis) and the expected effect at a height."""
    colour, faint = (COLOURS[row.verdict], 1.0) if row.decides else (MUTED, 0.7)
    left, right = axes.get_xlim()
    if row.low is not None:
        axes.hlines(place, max(row.low, left), min(row.high, right), color=colour, linewidth=2.2, alpha=faint)
        for beyond, end, mark in ((row.low < left, left, "<"), (row.high > right, right, ">")):
            if beyond:
                axes.plot(end, place, mark, color=colour, markersize=6, alpha=faint, clip_on=False)
    if row.expected is not None:
        axes.plot(row.expected, place, "D", color=INK, markersize=7, markerfacecolor="none", markeredgewidth=1.4)
    if row.mean is not None:
        face = colour if row.decides else "white"
        axes.plot(row.mean, place, "o", color=colour, markersize=7, markerfacecolor=face, alpha=faint)


def draw_forest(path: Path | str, groups: Sequence[ForestGroup], title: str, axis: str) -> None:
    """Write a PNG of all groups on one axis, whose meaning is `axis`."""
    height = sum(HEAD_PX + ROW_PX * len(group.rows) for group in groups)
    canvas = Canvas(SHEET_PX, TOP_PX + height + FOOT_PX)
    canvas.text(16, 12, title, 20, bold=True)
    keys = [Line2D([], [], color=colour, marker="o", linewidth=2.2, label=name) for name, colour in COLOURS.items()]
    keys[-1].set_linestyle("none")
    keys += [Line2D([], [], color=MUTED, marker="o", markerfacecolor="white", label="shown beside, decides nothing")]
    keys += [
        Line2D([], [], color=INK, marker="D", markerfacecolor="none", linestyle="none", label="the paper's effect")
    ]
    canvas.legend(16, 48, keys)
    left, width = PLOT_PX
    axes = canvas.axes(left, TOP_PX, width, height)
    axes.set(xlim=reach(groups), ylim=(height, 0), yticks=[])
    quiet_axes(axes, grid="x")
    axes.axvline(0, color="#868E96", linewidth=1.2, zorder=1)
    axes.set_xlabel(axis, color=AXIS_INK, fontsize=10, parse_math=False)
    top = TOP_PX
    for group in groups:
        below = top - TOP_PX  # no line of the plot crosses a long title
        axes.axhspan(below, below + HEAD_PX, color="white", linewidth=0, zorder=1.5)
        canvas.text(16, top + 11, group.title, 15, bold=True)
        canvas.text(SHEET_PX - 16, top + 11, group.verdict, 15, bold=True, colour=COLOURS[group.verdict], align="right")
        top += HEAD_PX
        for row in group.rows:
            axes.axhline(top - TOP_PX + ROW_PX / 2, color="#F1F3F5", linewidth=0.8, zorder=0)
            paint_row(axes, top - TOP_PX + ROW_PX / 2, row)
            ink = INK if row.decides else MUTED
            canvas.text(32, top + 6, row.label, 13, colour=ink)
            canvas.text(left - 16, top + 6, row.measure, 13, colour=ink, align="right")
            canvas.text(left + width + 16, top + 6, row.numbers, 13, colour=ink)
            top += ROW_PX
    canvas.save(path, photographs=False)
