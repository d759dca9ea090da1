"""Pictures of two suites: scaling, time and memory over what grows; soak, what is held over thousands of frames."""

from __future__ import annotations

import math
from collections.abc import Callable
from operator import itemgetter
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, NullFormatter, NullLocator

from src.pictures.canvas import SHEET_PX, Canvas
from src.pictures.contents import AXIS_INK, INK
from src.pictures.learning_curves import LINE_COLOURS, LINE_DASHES, LINE_MARKERS, style_axes

COLUMNS, PANEL_PX, GAP_PX = 4, (300, 220), (92, 96)
SOAK_PANEL_PX, SOAK_GAP_PX = (400, 170), (112, 96)
LABEL_GAP_PT = 9.0
LEFT_PX, TOP_PX = 66, 104
SOAK_PANELS = {
    "memory, MiB": ("RSS MiB", "heap MiB", "workers MiB", "CUDA MiB", "CUDA reserved MiB", "remembered MiB"),
    "ms a frame": ("ms",),
    "live tensors": ("tensors",),
    "Python objects": ("objects",),
    "handles": ("descriptors", "threads"),
}
"""Columns of the curves that each row of the picture shows, by the row's title."""

Rows = list[dict[str, Any]]
Line = list[tuple[float, float]]  # places and values


def held_mib(point: dict[str, Any]) -> float:
    """Memory that a frame adds, and that of what is remembered."""
    return (point["added MiB"] or 0.0) + point["remembered MiB"]


def draw_scaling(path: Path, measured: dict[str, Rows], title: str, fixed: str) -> None:
    """Time over every sweep, memory over the two ranges, and time by part over the sweep `fixed`, of all models."""
    models = list(dict.fromkeys(point["model"] for point in measured[fixed]))

    def lines_of(name: str, value_of: Callable[[dict[str, Any]], float]) -> dict[str, Line]:
        return {
            model: [(point[name], value_of(point)) for point in measured[name] if point["model"] == model]
            for model in models
        }

    panels = [("ms a frame", name, lines_of(name, itemgetter("ms"))) for name in measured]
    ranges = [name for name in measured if name.startswith("range")]
    panels += [("MiB added and remembered", name, lines_of(name, held_mib)) for name in ranges]
    for model in models:
        own = [point for point in measured[fixed] if point["model"] == model]
        parts = [key for key in own[-1] if key.endswith(" ms") and key != "± ms"]
        parts.sort(key=lambda part: -own[-1][part])
        lines = {part.removesuffix(" ms"): [(point[fixed], point.get(part, 0.0)) for point in own] for part in parts}
        panels.append((f"{model}: ms by part", fixed, lines))

    canvas = Canvas(SHEET_PX, TOP_PX - (-len(panels) // COLUMNS) * (PANEL_PX[1] + GAP_PX[1]))
    canvas.text(12, 10, title, 20, bold=True)
    for place, (heading, name, lines) in enumerate(panels):
        row, column = divmod(place, COLUMNS)
        left, top = LEFT_PX + column * (PANEL_PX[0] + GAP_PX[0]), TOP_PX + row * (PANEL_PX[1] + GAP_PX[1])
        axes = _panel(canvas, (left, top), PANEL_PX, heading, lines)
        _log_where_wide(axes)
        _label(axes, name)
        if heading.endswith("by part"):
            factor = 6.0 if axes.get_yscale() == "log" else 1.5
            axes.set_ylim(top=factor * axes.get_ylim()[1])  # room for the legend
            axes.legend(loc="upper left", fontsize=7, frameon=False, labelcolor=INK, ncols=2, columnspacing=0.8)
        _part_labels(axes)
    canvas.legend(12, 48, canvas.figure.axes[0].get_legend_handles_labels()[0])
    canvas.save(path, photographs=False)


def draw_soak(path: Path, curves: dict[str, Rows], title: str) -> None:
    """What was held and how long a frame took over the frames passed: a column for each pass, one scale in a row."""
    size, gap, first = SOAK_PANEL_PX, SOAK_GAP_PX, 112
    known = {quantity for rows in curves.values() for point in rows for quantity in point}
    shown = {what: own for what, names in SOAK_PANELS.items() if (own := [name for name in names if name in known])}
    canvas = Canvas(SHEET_PX, first + len(SOAK_PANELS) * (size[1] + gap[1]) - 36)
    canvas.text(12, 10, title, 20, bold=True)
    for row, (what, quantities) in enumerate(shown.items()):
        top, panels = first + row * (size[1] + gap[1]), []
        for column, (name, rows) in enumerate(curves.items()):
            lines = {
                quantity.removesuffix(" MiB"): [(at["frames"], at[quantity]) for at in rows if quantity in at]
                for quantity in quantities
            }
            panels.append(_panel(canvas, (LEFT_PX + column * (size[0] + gap[0]), top), size, f"{name}: {what}", lines))
        highest = max(max(line.get_ydata()) for axes in panels for line in axes.lines) or 1.0
        keys: dict[str, Any] = {}
        for axes in panels:
            axes.set_xlabel("frames", color=AXIS_INK, fontsize=9)
            axes.set_xlim(0, None)
            axes.set_ylim(0, 1.12 * highest)
            axes.yaxis.set_major_formatter("{x:,.0f}")
            keys |= {label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
        if len(quantities) > 1:
            canvas.legend(LEFT_PX, top - 52, list(keys.values()))
    canvas.save(path, photographs=False)


def _panel(
    canvas: Canvas, corner: tuple[float, float], size: tuple[float, float], title: str, lines: dict[str, Line]
) -> Axes:
    """Lines told apart by colour, marker and dashes, with their last values."""
    axes = canvas.axes(*corner, *size)
    style_axes(axes, title)
    for index, (label, line) in enumerate(lines.items()):
        if not line:
            continue
        style = {"color": LINE_COLOURS[index % len(LINE_COLOURS)], "marker": LINE_MARKERS[index % len(LINE_MARKERS)]}
        style["linestyle"] = LINE_DASHES[index % len(LINE_DASHES)]
        axes.plot(*zip(*line, strict=True), label=label, linewidth=1.6, markersize=4, **style)
        last = line[-1][1]
        text = f"{last:,.0f}" if last >= 10 or last == int(last) else f"{last:.2g}"
        beside = {"textcoords": "offset points", "va": "center", "fontsize": 8, "color": INK}
        axes.annotate(text, line[-1], (6, 0), annotation_clip=False, **beside)
    return axes


def _part_labels(axes: Axes) -> None:
    """Last values that would lie upon each other are moved up, once the limits are final."""
    points_per_pixel = 72.0 / axes.figure.dpi
    top = -math.inf
    for label in sorted(axes.texts, key=lambda label: label.xy[1]):
        own = points_per_pixel * float(axes.transData.transform(label.xy)[1])
        top = max(own, top + LABEL_GAP_PT)
        label.set_position((6, top - own))


def _log_where_wide(axes: Axes) -> None:
    """Logarithmic where values differ by more than a factor of four, else from zero; room above for labels."""
    values = [value for line in axes.lines for value in line.get_ydata()]
    if min(values) > 0 and max(values) > 4 * min(values):
        axes.set_yscale("log")
        axes.set_ylim(0.6 * min(values), 4.0 * max(values))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(NullFormatter())
    else:
        axes.set_ylim(0, 1.4 * max(values))


def _label(axes: Axes, name: str) -> None:
    places = sorted({place for line in axes.lines for place in line.get_xdata()})
    axes.set_xlabel(f"{name}, m" if name.startswith("range") else name, color=AXIS_INK, fontsize=9)
    if name != "memory frames" and places[0] > 0:
        axes.set_xscale("log", base=2)
        axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_locator(FixedLocator(places))
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.tick_params(axis="x", labelsize=8)
