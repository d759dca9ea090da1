"""Pictures of the synthetic world: one key frame per scene, and its radar beside a real sweep."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from src.pictures.bev import frame_axes, paint_boxes, paint_ego, paint_radar
from src.pictures.cameras import PictureViews, cameras_height, paint_cameras
from src.pictures.canvas import SHEET_PX, Canvas
from src.pictures.contents import INK, MUTED, PictureBoxes
from src.pictures.legends import class_keys, radar_keys

Array = np.ndarray

MARGIN_PX = 10
GAP_PX = 12
HEADER_PX = 74
CAPTION_PX = 34
RANGE_M = 153.6
NEAR_M = 60.0
REAL_COLOUR = "#D55E00"
SIMULATED_COLOUR = "#0072B2"


def draw_scene_preview(
    path: Path | str,
    views: PictureViews,
    boxes: PictureBoxes,  # ground truth
    radar_points: Array,  # [P, 7] x, y, z (m), rcs (dB), vx, vy (m/s, compensated, radial), dt (s)
    title: str,
) -> None:
    """Write one PNG of a key frame: cameras with projected boxes, radar from above, ground truth with velocities.

    Everything is in ego metres, forward is up. Boxes carry class colours; arrows show the travel in half a second;
    radar points are grey where they stand, blue where they approach, orange where they recede.
    """
    shown = boxes.drawable()
    wide = SHEET_PX - 2 * MARGIN_PX
    camera_px = cameras_height(views, wide)
    half = (wide - GAP_PX) / 2
    top = HEADER_PX + camera_px + GAP_PX
    canvas = Canvas(SHEET_PX, round(top + 2 * (CAPTION_PX + half) + GAP_PX))
    canvas.text(MARGIN_PX, 8, title, 20, bold=True)
    canvas.legend(MARGIN_PX, 44, class_keys(set(shown.labels.tolist())))
    paint_cameras(canvas, views, (MARGIN_PX, HEADER_PX, wide), shown, PictureBoxes.empty())
    for row, reach in enumerate((RANGE_M, NEAR_M)):
        high = top + row * (CAPTION_PX + half)
        size = f"±{reach:g} m"
        axes = _panel(canvas, MARGIN_PX, high, half, reach, f"Radar, {size}")
        canvas.legend(MARGIN_PX + 170, high + 11, radar_keys(), size_px=12)
        paint_radar(axes, radar_points)
        paint_boxes(axes, shown, predicted=False, arrows=False)
        axes = _panel(
            canvas, MARGIN_PX + half + GAP_PX, high, half, reach, f"Ground truth, {size}, arrows: travel in 0.5 s"
        )
        paint_boxes(axes, shown, predicted=True)
    canvas.save(path)


def _panel(canvas: Canvas, left: float, top: float, size: float, reach_m: float, caption: str) -> Axes:
    canvas.text(left, top + 9, caption, 15, bold=True)
    axes = canvas.axes(left, top + CAPTION_PX, size, size)
    frame_axes(axes, (-reach_m, reach_m), (-reach_m, reach_m))
    paint_ego(axes)
    return axes


def draw_radar_comparison(
    path: Path | str,
    real: Array,  # [n, 7] one sweep in its sensor frame: x, y, z, vrel_x, vrel_y, vrel_z, rcs
    real_speed_mps: Array,  # [n] radial speed over ground
    simulated: Sequence[Array],  # sweeps [m, 7] of the same mount
    simulated_speed_mps: Sequence[Array],  # [m] each
) -> None:
    """Write one PNG: a real and a simulated sweep from above, and how range, RCS, angles and speed spread."""
    canvas = Canvas(SHEET_PX, 1180)
    canvas.text(
        MARGIN_PX, 8, f"One real sweep ({len(real)} points) beside {len(simulated)} simulated ones", 20, bold=True
    )
    half = (SHEET_PX - 3 * MARGIN_PX) / 2
    first = int(np.argmax([len(sweep) for sweep in simulated]))
    pairs = (
        (real, real_speed_mps, "real", REAL_COLOUR),
        (simulated[first], simulated_speed_mps[first], "simulated", SIMULATED_COLOUR),
    )
    for column, (points, speeds, name, colour) in enumerate(pairs):
        left = MARGIN_PX + column * (half + MARGIN_PX)
        canvas.text(
            left, 44, f"{name}, sensor frame (x up), {len(points)} points; dark: moving", 14, bold=True, colour=colour
        )
        axes = canvas.axes(left, 72, half, 560)
        moving = np.abs(speeds) > 1.0
        axes.scatter(-points[~moving, 1], points[~moving, 0], s=6, color=MUTED, linewidths=0)
        axes.scatter(-points[moving, 1], points[moving, 0], s=12, color=colour, linewidths=0)
        axes.set_xlim(-140, 140)
        axes.set_ylim(0, 195)
        axes.set_aspect("equal", adjustable="box")
        axes.set_xticks([])
        axes.set_yticks([])
    everything = np.concatenate(list(simulated))
    speeds = np.concatenate(list(simulated_speed_mps))
    rows = [
        ("range, m", np.linspace(0, 200, 41), _range(real), _range(everything)),
        ("RCS, dB", np.arange(-22, 40, 2.0), real[:, 6], everything[:, 6]),
        ("azimuth, degrees", np.linspace(-65, 65, 27), _azimuth(real), _azimuth(everything)),
        ("elevation, degrees", np.linspace(-12, 12, 25), _elevation(real), _elevation(everything)),
        ("compensated radial speed, m/s", np.linspace(-50, 50, 41), real_speed_mps, speeds),
    ]
    wide = (SHEET_PX - 6 * MARGIN_PX) / 5
    for column, (name, edges, truth, model) in enumerate(rows):
        left = MARGIN_PX + column * (wide + MARGIN_PX)
        canvas.text(left, 660, name, 14, bold=True)
        axes = canvas.axes(left + 34, 690, wide - 34, 430)
        for values, colour, label in ((truth, REAL_COLOUR, "real"), (model, SIMULATED_COLOUR, "simulated")):
            axes.hist(
                np.clip(values, edges[0], edges[-1]),
                edges,
                density=True,
                histtype="step",
                color=colour,
                linewidth=1.8,
                label=label,
            )
        if "speed" in name:
            axes.set_yscale("log")
        axes.tick_params(colors=INK, labelsize=7)
        axes.legend(fontsize=8, frameon=False)
    canvas.save(path)


def _range(points: Array) -> Array:
    return np.linalg.norm(points[:, :3], axis=1)


def _azimuth(points: Array) -> Array:
    return np.degrees(np.arctan2(points[:, 1], points[:, 0]))


def _elevation(points: Array) -> Array:
    return np.degrees(np.arcsin(points[:, 2] / np.maximum(_range(points), 1e-6)))
