"""Training curves over steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullLocator

from src.pictures.canvas import SHEET_PX, Canvas
from src.pictures.contents import AXIS_INK, FRAME_COLOUR, GRID_COLOUR, INK, MUTED

Curves = Mapping[str, Sequence[tuple[int, float]]]  # name -> step, value

LINE_COLOURS = (
    "#0072B2", "#D55E00", "#00846B", "#8C2D7E", "#E6A000", "#3DA5D9", "#6B3E1E", "#E7298A", "#4B3BB5", "#212529"
)  # fmt: skip
LINE_MARKERS = "os^Dv<>PhX"
LINE_DASHES = ("-", (0, (5, 1.6)), (0, (1.4, 1.4)))
HEIGHT_PX = 520


def style_axes(axes: Axes, title: str) -> None:
    """Quiet frame: light grid, no box, title at the left."""
    axes.set_title(title, loc="left", fontsize=11, fontweight="bold", color=INK, parse_math=False)
    quiet_axes(axes)
    axes.spines["bottom"].set_color(FRAME_COLOUR)


def quiet_axes(
    axes: Axes,
    grid: Literal["x", "y", "both"] = "y",
    label_size: float = 9,
    without: Sequence[str] = ("top", "right", "left"),
) -> None:
    """A light grid below what is drawn, labels without ticks, no frame at some sides."""
    axes.grid(axis=grid, color=GRID_COLOUR, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(colors=AXIS_INK, labelsize=label_size, length=0)
    for side in without:
        axes.spines[side].set_visible(False)


def paint_lines(axes: Axes, curves: Curves) -> None:
    """One line per curve with a legend at the right, highest last value first."""
    for index, name in enumerate(sorted(curves, key=lambda name: -curves[name][-1][1])):
        steps, values = zip(*curves[name], strict=True)
        label = f"{name.replace('$', chr(92) + '$')}  {values[-1]:.3g}"  # legends would read $ as a formula
        dashes = LINE_DASHES[index // len(LINE_COLOURS) % len(LINE_DASHES)]
        colour = LINE_COLOURS[index % len(LINE_COLOURS)]
        style = {"color": colour, "linestyle": dashes, "linewidth": 1.8, "marker": "o", "markersize": 3}
        axes.plot(steps, values, label=label, **style)
    axes.set_xlabel("step", color=AXIS_INK, fontsize=9)
    axes.xaxis.get_major_locator().set_params(integer=True)
    if curves:
        axes.legend(
            loc="upper left", bbox_to_anchor=(1.01, 1.0), borderaxespad=0, frameon=False, fontsize=8.5, labelcolor=INK
        )
    else:
        axes.text(0.5, 0.5, "nothing logged yet", transform=axes.transAxes, ha="center", color=MUTED)


def draw_curves(path: Path | str, curves: Curves, title: str = "") -> None:
    """Write a PNG of learning curves over steps: every one named *loss* (left, logarithmic), mAP and NDS (right).

    Without mAP and NDS, all of `val/` stand at the right.
    """
    losses = {name: line for name, line in curves.items() if "loss" in name.lower()}
    scores = {name: line for name, line in curves.items() if name.split("/")[-1].lower() in ("map", "nds")}
    scores = scores or {name: line for name, line in curves.items() if name.startswith("val/")}
    canvas = Canvas(SHEET_PX, HEIGHT_PX)
    canvas.text(12, 10, title, 20, bold=True)
    left = canvas.axes(70, 80, 520, HEIGHT_PX - 140)
    style_axes(left, "Loss terms")
    paint_lines(left, losses)
    if losses and all(value > 0 for line in losses.values() for _, value in line):
        left.set_yscale("log")
        left.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        left.yaxis.set_major_formatter("{x:g}")
        left.yaxis.set_minor_locator(NullLocator())
    right = canvas.axes(930, 80, 470, HEIGHT_PX - 140)
    style_axes(right, "Validation")
    paint_lines(right, scores)
    right.set_ylim(bottom=0)
    canvas.save(path)
