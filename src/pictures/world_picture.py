"""What a world model says of space and time: slices of occupancy, and forecasts of LiDAR beside the true points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from src.pictures.bev import SPEED_COLOURS, SPEED_LIMIT_MPS, bev_panel, upright
from src.pictures.canvas import GAP_PX, MARGIN_PX, SHEET_PX, Canvas
from src.pictures.comparison import BarPanel, draw_comparison
from src.pictures.contents import FRAME_COLOUR, INK, MUTED, OCCUPANCY_COLOUR, PANEL_COLOUR, Window
from src.structures.taxonomy import MOVING_MPS

Array = np.ndarray

WINDOW: Window = ((-40.0, 40.0), (-40.0, 120.0))
"""(right, up) m that every panel from above shows: where a highway changes within three seconds."""
HEADER_PX, CAPTION_PX = 44, 44
PANEL_PX = (386, 772)
"""Width and height of a slice; four stand side by side."""
VIEW_PX = (300, 600)
"""Width and height of a forecast from above; the rest of its row is seen from the sensors."""
BEARING_DEG, ELEVATION_DEG = 100.0, (-24.0, 12.0)
"""What the view from the sensors shows to each side, and below and above the horizon."""
RANGES_M = (3.0, 200.0)
BASELINE = "static-world baseline"
FORECAST_COLOUR, STATIC_COLOUR, TRUE_COLOUR = "#F0A36B", "#7DB9DE", INK
SENSORS_COLOUR = "#B5006E"


@dataclass
class OccupancySlice:
    """A level slice of space at one time, in the ego frame of the present."""

    time_s: float
    points: Array  # [n, 2] m, centres of square cells
    cell_m: float
    occupancy: Array  # [n] probability
    speeds: Array | None  # [n] m/s along the ray from the ego, None where none is predicted
    solid: Array | None  # [n] bool, what is really there; None where nobody knows


@dataclass
class ForecastMoment:
    """One moment's rays: the true ranges and the forecast ones."""

    time_s: float
    origins: Array  # [R, 3] m, ego frame of the present
    directions: Array  # [R, 3] of length 1
    true_m: Array  # [R] ranges
    forecast_m: Array  # [R]
    static_m: Array  # [R] of a world that stands still


def draw_slices(path: Path | str, slices: Sequence[OccupancySlice], title: str, height_m: float) -> None:
    """Write a PNG of up to four slices side by side: occupancy by its shade, moving objects by their radial speed."""
    width, height = PANEL_PX
    canvas = Canvas(SHEET_PX, HEADER_PX + CAPTION_PX + height + MARGIN_PX)
    canvas.text(MARGIN_PX, 10, f"{title}: occupancy {height_m:g} m above the ground", 20, bold=True)
    keys = [Patch(color=OCCUPANCY_COLOUR, label="occupied")]
    if any(one.speeds is not None for one in slices):
        colours = [("comes nearer", -SPEED_LIMIT_MPS), ("moves away", SPEED_LIMIT_MPS)]
        limits = Normalize(-SPEED_LIMIT_MPS, SPEED_LIMIT_MPS)
        keys += [Patch(color=SPEED_COLOURS(limits(speed)), label=label) for label, speed in colours]
    if any(one.solid is not None for one in slices):
        keys.append(Line2D([], [], color=INK, linewidth=1, label="truth"))
    canvas.legend(1050, 14, keys)
    for column, one in enumerate(slices):
        left = MARGIN_PX + column * (width + GAP_PX)
        axes = bev_panel(canvas, (left, HEADER_PX + CAPTION_PX, width, height), WINDOW, f"t = {one.time_s:g} s")
        _paint_slice(axes, one)
    canvas.save(path, photographs=False)


def _paint_slice(axes: Axes, one: OccupancySlice) -> None:
    cells = np.floor((one.points - one.points.min(0)) / one.cell_m + 0.5).astype(np.int64)
    shape = tuple(cells.max(0) + 1)  # along x (up), along y (left)
    image = np.zeros((*shape, 4))
    colours = np.tile([*OCCUPANCY_COLOUR, 1.0], (len(cells), 1))
    if one.speeds is not None:
        moving = np.abs(one.speeds) >= MOVING_MPS
        colours[moving] = SPEED_COLOURS(Normalize(-SPEED_LIMIT_MPS, SPEED_LIMIT_MPS)(one.speeds[moving]))
    colours[:, 3] = np.clip(one.occupancy, 0, 1)
    image[cells[:, 0], shape[1] - 1 - cells[:, 1]] = colours
    low, high = one.points.min(0) - 0.5 * one.cell_m, one.points.max(0) + 0.5 * one.cell_m
    extent, limits = (-high[1], -low[1], low[0], high[0]), (axes.get_xlim(), axes.get_ylim())
    axes.imshow(image, extent=extent, origin="lower", interpolation="nearest", aspect="equal", zorder=1)
    if one.solid is not None and one.solid.any():
        solid = np.zeros(shape)
        solid[cells[:, 0], shape[1] - 1 - cells[:, 1]] = one.solid
        axes.contour(solid, levels=[0.5], extent=extent, origin="lower", colors=INK, linewidths=0.8, zorder=3)
    axes.set_xlim(*limits[0])
    axes.set_ylim(*limits[1])


def draw_forecast(path: Path | str, moments: Sequence[ForecastMoment], title: str) -> None:
    """Write a PNG with a row per moment: forecast and baseline over the true points, and the sensors' views."""
    width, height = VIEW_PX
    row_px = CAPTION_PX + height + GAP_PX
    canvas = Canvas(SHEET_PX, HEADER_PX + row_px * len(moments) + MARGIN_PX)
    canvas.text(MARGIN_PX, 10, title, 20, bold=True)
    names = {"true points": TRUE_COLOUR, "forecast": FORECAST_COLOUR, BASELINE: STATIC_COLOUR}
    names |= {"LiDARs at that time": SENSORS_COLOUR}
    style = {"linestyle": "none", "marker": "o", "markersize": 5}
    canvas.legend(880, 14, [Line2D([], [], color=colour, label=name, **style) for name, colour in names.items()])
    for row, one in enumerate(moments):
        top = HEADER_PX + row * row_px + CAPTION_PX
        when = f"in {one.time_s:.1f} s"
        found = {"forecast": one.forecast_m, BASELINE: one.static_m}
        for column, (name, ranges) in enumerate(found.items()):
            area = (MARGIN_PX + column * (width + GAP_PX), top, width, height)
            axes = bev_panel(canvas, area, WINDOW, f"{name} {when}")
            _paint_ends(axes, one, ranges, names[name], 3.0)
            _paint_ends(axes, one, one.true_m, TRUE_COLOUR, 1.1)  # within the other's where that is right
            axes.plot(*upright(one.origins[:, :2]).T, "o", color=SENSORS_COLOUR, markersize=2.0, markeredgewidth=0)
        left = 2 * (MARGIN_PX + width + GAP_PX)
        _paint_views(canvas, one, {"true points": one.true_m} | found, (left, top, SHEET_PX - left - 80, height))
    canvas.save(path, photographs=False)


def _paint_ends(axes: Axes, one: ForecastMoment, ranges: Array, colour: str, size: float) -> None:
    ends = upright((one.origins + ranges[:, None] * one.directions)[:, :2])
    axes.plot(*ends.T, "o", markersize=size, markeredgewidth=0, color=colour)


def _paint_views(
    canvas: Canvas, one: ForecastMoment, views: Mapping[str, Array], area: tuple[float, float, float, float]
) -> None:
    """Rays by bearing and elevation in the colour of their range, one view above the other."""
    left, top, width, height = area
    bearing, elevation = np.degrees([np.arctan2(*one.directions[:, 1::-1].T), np.arcsin(one.directions[:, 2])])
    each = (height + CAPTION_PX) / len(views)
    order = np.argsort(-one.true_m)  # the nearest on top
    norm = LogNorm(*RANGES_M, clip=True)
    for row, (name, ranges) in enumerate(views.items()):
        at = top + row * each
        canvas.text(left, at - 25, f"{name}, from the sensors, in {one.time_s:.1f} s", 15, bold=True)
        axes = canvas.axes(left, at, width, each - CAPTION_PX)
        painted = axes.scatter(
            -bearing[order], elevation[order], s=5, c=ranges[order], cmap="turbo_r", norm=norm, linewidths=0
        )
        axes.set_xlim(-BEARING_DEG, BEARING_DEG)
        axes.set_ylim(*ELEVATION_DEG)
        axes.set_xticks([-90, -45, 0, 45, 90], ["left", "", "ahead", "", "right"], fontsize=8, color=MUTED)
        axes.set_yticks([])
        axes.tick_params(length=0, pad=2)
        axes.set_facecolor(PANEL_COLOUR)
        for spine in axes.spines.values():
            spine.set_color(FRAME_COLOUR)
    bar = canvas.figure.colorbar(painted, cax=canvas.axes(left + width + 12, top, 12, height))
    bar.set_ticks([3, 10, 30, 100, 200], labels=["3 m", "10", "30", "100", "200"], fontsize=8)
    bar.minorticks_off()
    bar.outline.set_visible(False)


def draw_horizons(path: Path | str, scores: Mapping[str, Any], title: str) -> None:
    """Write a PNG of a world model's scores over time and distance with their intervals, from metrics.json."""
    bounds = scores.get("intervals", {}).get("bounds", {})
    times = sorted({name.partition("@")[2] for name in scores if "@" in name}, key=lambda name: float(name[:-1]))

    def bar(name: str, scale: float) -> tuple[float, float, float] | None:
        value = scores.get(name)
        return None if value is None else tuple(scale * x for x in (value, *bounds.get(name, (value, value))))

    def bars(names: Sequence[str], scale: float = 1.0) -> list[tuple[float, float, float] | None]:
        return [bar(name, scale) for name in names]

    panels = [
        BarPanel(
            "Occupancy IoU, %",
            times,
            {
                words: bars([f"{kind}@{time}" for time in times], 100)
                for kind, words in (("iou", "along rays"), ("slice_iou", "above the ground"))
            },
        )
    ]
    own = {"": "forecast", "static_": BASELINE}
    future = [time for time in times if f"cd@{time}" in scores]
    distances = ("0-50m", "50-150m", "150-250m")
    if future:
        parts = ("cd", ""), ("cd_moving", " of moving objects"), ("cd_unseen", " where the input had not seen")
        for kind, of in parts:
            words = f"Chamfer distance{of}, m^2"
            found = {name: bars([f"{prefix}{kind}@{time}" for time in future]) for prefix, name in own.items()}
            panels.append(BarPanel(words, future, found, 2))
        errors = {name: bars([f"{prefix}l1_{far}_3s" for far in distances]) for prefix, name in own.items()}
        panels.append(BarPanel("Error along rays up to 3 s by distance, m", distances, errors, 2))
    draw_comparison(path, panels, title)
