"""Scores over what they cost: a point for each method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.transforms import Bbox

from src.pictures.canvas import SHEET_PX, Canvas
from src.pictures.contents import AXIS_INK, MUTED
from src.pictures.learning_curves import LINE_COLOURS, LINE_MARKERS, quiet_axes

HEIGHT_PX = 560
LABEL_PLACES = ((9, 5), (9, -14), (-9, 5), (-9, -14), (9, 20), (-9, 20), (9, -28), (-9, -28))
"""Where a point's label may begin, or end where the first is negative, in points from it."""
MARKER_PX = 6.0


@dataclass(frozen=True)
class TradeOff:
    """One method: a score with its interval, and what it costs."""

    label: str
    cost: float
    score: float
    low: float
    high: float


def efficient(points: Sequence[TradeOff]) -> list[TradeOff]:
    """The Pareto front: points that no other beats by a higher score at no higher cost, the cheapest first."""
    kept: list[TradeOff] = []
    for point in sorted(points, key=lambda point: (point.cost, -point.score)):
        if not kept or point.score > kept[-1].score:
            kept.append(point)
    return kept


def paint_points(axes: Axes, points: Sequence[TradeOff]) -> None:
    """Points with intervals and labels, and a step line through the efficient ones."""
    best = efficient(points)
    axes.step([p.cost for p in best], [p.score for p in best], where="post", color="#ADB5BD", linewidth=1.2, zorder=1)
    for number, point in enumerate(points):
        colour, marker = LINE_COLOURS[number % len(LINE_COLOURS)], LINE_MARKERS[number % len(LINE_MARKERS)]
        axes.vlines(point.cost, point.low, point.high, color=colour, linewidth=1.6, alpha=0.6)
        axes.plot(point.cost, point.score, marker, color=colour, markersize=8, clip_on=False)
        place = {"xytext": (9, 5), "textcoords": "offset points"}
        axes.annotate(point.label, (point.cost, point.score), **place, fontsize=10, color=colour, parse_math=False)


def spread_labels(axes: Axes) -> None:
    """Put every label at the first of its places above the axis where it covers no point and no label before it.

    Where there is none it stands at the first of all.
    """
    renderer = axes.figure.canvas.get_renderer()
    centres = [axes.transData.transform(label.xy) for label in axes.texts]
    taken = [Bbox.from_extents(x - MARKER_PX, y - MARKER_PX, x + MARKER_PX, y + MARKER_PX) for x, y in centres]
    for label in axes.texts:
        for place in (*LABEL_PLACES, LABEL_PLACES[0]):
            label.xyann = place
            label.set_horizontalalignment("left" if place[0] > 0 else "right")
            box = label.get_window_extent(renderer)
            if box.y0 >= axes.bbox.y0 and not any(box.overlaps(other) for other in taken):
                break
        taken.append(box)


def draw_trade_off(path: Path | str, points: Sequence[TradeOff], title: str, cost: str, score: str) -> None:
    """Write a PNG of all points; `cost` and `score` name the axes, which begin at zero."""
    canvas = Canvas(SHEET_PX, HEIGHT_PX)
    canvas.text(16, 12, title, 20, bold=True)
    canvas.text(16, 44, "bars: 95 % intervals over scenes; line: the best score at each cost", 13, colour=MUTED)
    axes = canvas.axes(80, 80, SHEET_PX - 120, HEIGHT_PX - 150)
    paint_points(axes, points)
    axes.set(xlim=(0, 1.15 * max(p.cost for p in points)), ylim=(0, 1.08 * max(p.high for p in points)))
    spread_labels(axes)
    quiet_axes(axes, grid="both", label_size=10, without=("top", "right"))
    axes.set_xlabel(cost, color=AXIS_INK, fontsize=11, parse_math=False)
    axes.set_ylabel(score, color=AXIS_INK, fontsize=11, parse_math=False)
    canvas.save(path, photographs=False)
