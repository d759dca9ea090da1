"""Grouped bars with their intervals: several experiments side by side, or one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Patch

from src.pictures.canvas import SHEET_PX, Canvas
from src.pictures.contents import INK, MUTED
from src.pictures.learning_curves import LINE_COLOURS, style_axes

HEIGHT_PX = 360
"""Height of one panel with its title and labels."""

KEYS_PER_ROW = 4


@dataclass
class BarPanel:
    """One panel: for each experiment a mean and its interval per group, None where it has no number."""

    title: str
    groups: Sequence[str]  # g names along the axis
    bars: Mapping[str, Sequence[tuple[float, float, float] | None]]  # experiment -> g (mean, low, high)
    digits: int = 1


def paint_groups(axes: Axes, panel: BarPanel, colours: Mapping[str, str]) -> None:
    """Bars of all experiments side by side in each group, the interval as a whisker, the mean above it."""
    count = max(len(panel.bars), 1)
    width = 0.86 / count
    top = 0.0
    for index, (name, values) in enumerate(panel.bars.items()):
        for group, value in enumerate(values):
            place = group + (index - (count - 1) / 2) * width
            if value is None:
                axes.annotate("-", (place, 0), (0, 2), textcoords="offset points", ha="center", fontsize=8, color=MUTED)
                continue
            mean, low, high = value
            end = max(mean, high)
            top = max(top, end)
            axes.bar(place, mean, width * 0.88, color=colours[name])
            if high > low:
                axes.vlines(place, low, high, color=INK, linewidth=1)
            axes.annotate(
                f"{mean:.{panel.digits}f}", (place, end), (0, 2), textcoords="offset points", ha="center",
                fontsize=8, color=INK,
            )  # fmt: skip
    axes.set_xticks(range(len(panel.groups)), panel.groups, fontsize=9, parse_math=False)
    axes.set_xlim(-0.5, max(len(panel.groups), 1) - 0.5)
    axes.set_ylim(0, 1.15 * top if top > 0 else 1.0)


def draw_comparison(path: Path | str, panels: Sequence[BarPanel], title: str = "") -> None:
    """Write a PNG of panels of grouped bars, one below the other, under the keys of the experiments if several."""
    names = list(dict.fromkeys(name for panel in panels for name in panel.bars))
    colours = {name: LINE_COLOURS[index % len(LINE_COLOURS)] for index, name in enumerate(names)}
    names = names if len(names) > 1 else []
    rows = int(np.ceil(len(names) / KEYS_PER_ROW))
    head = 50 + 24 * rows
    canvas = Canvas(SHEET_PX, head + HEIGHT_PX * max(len(panels), 1))
    canvas.text(12, 10, title, 20, bold=True)
    for row in range(rows):
        part = range(row * KEYS_PER_ROW, min((row + 1) * KEYS_PER_ROW, len(names)))
        keys = [Patch(color=colours[names[i]], label=names[i].replace("$", r"\$")) for i in part]
        canvas.legend(12, 46 + 24 * row, keys)
    for index, panel in enumerate(panels):
        axes = canvas.axes(50, head + HEIGHT_PX * index + 40, SHEET_PX - 80, HEIGHT_PX - 80)
        style_axes(axes, panel.title)
        paint_groups(axes, panel, colours)
    canvas.save(path)
