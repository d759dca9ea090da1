"""Pictures of two suites: scaling, time and memory over what grows; soak, what is held over thousands of frames."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, NullFormatter, NullLocator

from src.pictures.canvas import SHEET_PX, Canvas
from src.pictures.contents import INK
from src.pictures.learning_curves import LINE_COLOURS, style_axes

MARKERS = "os^Dv<>Ph"
DASHES = ("-", (0, (5, 1.6)), (0, (1, 1.2)))
PANEL_PX, GAP_PX = (300, 220), (92, 96)
LEFT_PX, TOP_PX = 66, 104

Rows = list[dict[str, Any]]


def draw_scaling(path: Path, measured: dict[str, Rows], title: str) -> None:
    """Time over every sweep, memory over the two ranges, and time by part over the fixed scene, of all models."""
    fixed = "range, fixed scene"
    panels = [("time", name, rows) for name, rows in measured.items()]
    panels += [("memory", name, rows) for name, rows in measured.items() if name.startswith("range")]
    models = list(dict.fromkeys(point["model"] for point in measured[fixed]))
    panels += [(model, fixed, measured[fixed]) for model in models]
    columns = 4
    lines = -(-len(panels) // columns)
    canvas = Canvas(SHEET_PX, TOP_PX + lines * (PANEL_PX[1] + GAP_PX[1]))
    canvas.text(12, 10, title, 20, bold=True)
    for place, (kind, name, rows) in enumerate(panels):
        row, column = divmod(place, columns)
        left = LEFT_PX + column * (PANEL_PX[0] + GAP_PX[0])
        axes = canvas.axes(left, TOP_PX + row * (PANEL_PX[1] + GAP_PX[1]), *PANEL_PX)
        if kind in models:
            style_axes(axes, f"{kind}: ms by part")
            _paint_parts(axes, name, [point for point in rows if point["model"] == kind])
        else:
            style_axes(axes, "ms a frame" if kind == "time" else "MiB added and remembered")
            _paint_models(axes, name, rows, kind, models)
        _label(axes, name, rows)
    first = canvas.figure.axes[0]
    canvas.legend(12, 48, first.get_legend_handles_labels()[0])
    canvas.save(path, photographs=False)


def _paint_models(axes: Axes, name: str, rows: Rows, kind: str, models: list[str]) -> None:
    """Models told apart by colour, marker and dashes."""
    for index, model in enumerate(models):
        style = {"color": LINE_COLOURS[index], "marker": MARKERS[index], "linestyle": DASHES[index % len(DASHES)]}
        own = [point for point in rows if point["model"] == model]
        if kind == "time":
            values = [point["ms"] for point in own]
        else:
            values = [(point["added MiB"] or 0.0) + point["remembered MiB"] for point in own]
        places = [point[name] for point in own]
        axes.plot(places, values, label=model, linewidth=2.0, markersize=5, **style)
        axes.annotate(
            f"{values[-1]:,.0f}", (places[-1], values[-1]), (4, 4), textcoords="offset points", fontsize=8, color=INK
        )
    _log_where_wide(axes, [value for line in axes.lines for value in line.get_ydata()])


def _paint_parts(axes: Axes, name: str, rows: Rows) -> None:
    parts = [key for key in rows[-1] if key.endswith(" ms") and key not in ("± ms",)]
    parts.sort(key=lambda key: -rows[-1][key])
    for index, part in enumerate(parts):
        places, values = [point[name] for point in rows], [point.get(part, 0.0) for point in rows]
        style = {"color": LINE_COLOURS[index % len(LINE_COLOURS)], "marker": MARKERS[index % len(MARKERS)]}
        axes.plot(places, values, label=part.removesuffix(" ms"), linewidth=1.6, markersize=4, **style)
    _log_where_wide(axes, [value for line in axes.lines for value in line.get_ydata()])
    axes.set_ylim(
        top=6.0 * axes.get_ylim()[1] if axes.get_yscale() == "log" else 1.5 * axes.get_ylim()[1]
    )  # the legend
    axes.legend(loc="upper left", fontsize=7, frameon=False, labelcolor=INK, ncols=2, columnspacing=0.8)


def _log_where_wide(axes: Axes, values: list[float]) -> None:
    """Logarithmic where values differ by more than a factor of four, else from zero; room above for labels."""
    if min(values) > 0 and max(values) > 4 * min(values):
        axes.set_yscale("log")
        axes.set_ylim(0.6 * min(values), 4.0 * max(values))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(NullFormatter())
    else:
        axes.set_ylim(0, 1.4 * max(values))


def _label(axes: Axes, name: str, rows: Rows) -> None:
    places = sorted({point[name] for point in rows})
    axes.set_xlabel(f"{name}, m" if name.startswith("range") else name, color="#495057", fontsize=9)
    if name != "memory frames" and places[0] > 0:
        axes.set_xscale("log", base=2)
        axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_locator(FixedLocator(places))
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.tick_params(axis="x", labelsize=8)


SOAK_PANELS = {
    "memory, MiB": ("RSS MiB", "heap MiB", "workers MiB", "CUDA MiB", "CUDA reserved MiB", "remembered MiB"),
    "ms a frame": ("ms",),
    "live tensors": ("tensors",),
    "Python objects": ("objects",),
    "handles": ("descriptors", "threads"),
}
"""By row of the picture the columns of the curves that it shows."""


def draw_soak(path: Path, curves: dict[str, Rows], title: str) -> None:
    """What was held and how long a frame took over the frames passed: a column for each pass, one scale in a row."""
    size, gap, first = (400, 170), (112, 96), 112
    canvas = Canvas(SHEET_PX, first + len(SOAK_PANELS) * (size[1] + gap[1]) - 36)
    canvas.text(12, 10, title, 20, bold=True)
    known = {quantity for rows in curves.values() for point in rows for quantity in point}
    shown = {what: own for what, names in SOAK_PANELS.items() if (own := [name for name in names if name in known])}
    for row, (what, quantities) in enumerate(shown.items()):
        top = first + row * (size[1] + gap[1])
        panels = []
        for column, (name, rows) in enumerate(curves.items()):
            axes = canvas.axes(LEFT_PX + column * (size[0] + gap[0]), top, *size)
            style_axes(axes, f"{name}: {what}")
            for index, quantity in enumerate(quantities):
                places = [point["frames"] for point in rows if quantity in point]
                values = [point[quantity] for point in rows if quantity in point]
                style = {"color": LINE_COLOURS[index], "marker": MARKERS[index], "linewidth": 1.6, "markersize": 4}
                if values:
                    axes.plot(places, values, label=quantity.removesuffix(" MiB"), **style)
                    last = values[-1]
                    text = f"{last:,.0f}" if last >= 10 or last == int(last) else f"{last:.2g}"
                    beside = {"textcoords": "offset points", "va": "center", "fontsize": 8, "color": INK}
                    axes.annotate(text, (places[-1], last), (6, 0), annotation_clip=False, **beside)
            axes.set_xlabel("frames", color="#495057", fontsize=9)
            axes.set_xlim(0, None)
            panels.append(axes)
        highest = max(max(line.get_ydata()) for axes in panels for line in axes.lines) or 1.0
        for axes in panels:
            axes.set_ylim(0, 1.12 * highest)
            axes.yaxis.set_major_formatter("{x:,.0f}")
        keys: dict[str, Any] = {}
        for axes in panels:
            keys |= {label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
        if len(quantities) > 1:
            canvas.legend(LEFT_PX, top - 52, list(keys.values()))
    canvas.save(path, photographs=False)
