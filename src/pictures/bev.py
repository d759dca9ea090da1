"""The bird's-eye view of a scene in ego metres: forward is up, left is left."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize, to_rgba
from matplotlib.patches import Circle, Polygon

from src.pictures.canvas import Canvas
from src.pictures.contents import (
    CLASS_COLOURS,
    CLASS_MARKERS,
    FRAME_COLOUR,
    INK,
    OCCUPANCY_COLOUR,
    PANEL_COLOUR,
    SOURCE_COLOURS,
    PictureBoxes,
    PictureGaussians,
    PictureGrid,
    Window,
    match_boxes,
)
from src.structures.taxonomy import CLASSES, MOVING_MPS, SOURCES

Array = np.ndarray

ARROW_S = 0.5
"""An arrow shows the travel in this time: the interval of two key frames, so its tip is the next position."""

SPEED_LIMIT_MPS = 30.0
SPEED_COLOURS = LinearSegmentedColormap.from_list("speed", ("#08519C", "#4A9BD4", "#B9BEC4", "#F08A3C", "#A63603"))
"""Blue comes nearer, orange moves away; grey stands."""

STANDING_COLOUR = "#9AA2AB"
LIDAR_COLOUR = "#7A828B"
MISSED_COLOUR = "#D7263D"
RINGS_M = (25, 50, 100, 150)


@dataclass
class BevScene:
    """What lies on the ground around one ego vehicle."""

    grid: PictureGrid
    predictions: PictureBoxes = field(default_factory=PictureBoxes.empty)
    ground_truth: PictureBoxes = field(default_factory=PictureBoxes.empty)
    radar_points: Array | None = None  # [P, 7] x, y, z (m), rcs (dB), vx, vy (m/s, compensated, radial), dt (s)
    gaussians: PictureGaussians | None = None
    occupancy: tuple[Array, Array] | None = None  # [n, 2] (row, col) cells and [n] alpha in 0..1
    lidar_points: Array | None = None  # [L, 3 or more] x, y, z (m); drawn where there is no radar

    def drawable(self, score_threshold: float) -> BevScene:
        """The scene with the boxes that are drawn, see PictureBoxes.drawable."""
        predictions = self.predictions.drawable(score_threshold)
        return replace(self, predictions=predictions, ground_truth=self.ground_truth.drawable())


def upright(
    xy: Array,  # [..., 2] ego metres (x forward, y left)
) -> Array:  # [..., 2] plot (right, up) metres
    """Ego metres as plot coordinates: forward is up, left is left."""
    return np.stack([-xy[..., 1], xy[..., 0]], axis=-1)


def bev_panel(
    canvas: Canvas,
    area: tuple[float, float, float, float],  # of the plot: left, top, width, height in picture pixels
    window: Window,
    caption: str,
    keys: Sequence[Artist] = (),
    note: str = "",
) -> Axes:
    """A plot of the ground with rings of equal range and the ego; above it the caption, and keys or a note."""
    left, top, width, height = area
    canvas.text(left, top - (41 if note else 25), caption, 15, bold=True)
    canvas.text(left, top - 21, note, 13)
    canvas.legend(left + 10 + 9.2 * len(caption), top - 23, keys, size_px=12)
    axes = canvas.axes(left, top, width, height)
    frame_ground(axes, window)
    axes.set_aspect("equal", adjustable="box")
    paint_rings(axes, *window)
    paint_ego(axes)
    return axes


def frame_ground(axes: Axes, window: Window) -> None:
    """An empty plot of the ground: its limits, its colours, no ticks."""
    axes.set_xlim(*window[0])
    axes.set_ylim(*window[1])
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_facecolor(PANEL_COLOUR)
    for spine in axes.spines.values():
        spine.set_color(FRAME_COLOUR)


def paint_rings(axes: Axes, right_m: tuple[float, float], up_m: tuple[float, float]) -> None:
    """Circles of equal range around the ego, labelled where the label fits into the window."""
    wide = right_m[1] - right_m[0] > 150
    turn = np.deg2rad(38 if wide else 62)  # from forward to the right, where roads seldom lead
    for radius in RINGS_M[1:] if wide else RINGS_M:
        axes.add_patch(Circle((0, 0), radius, fill=False, edgecolor="#D5D9DE", linewidth=1.0, zorder=0.5))
        right, up = radius * np.sin(turn), radius * np.cos(turn)
        if right_m[0] + 3 < right < right_m[1] - 3 and up_m[0] + 2 < up < up_m[1] - 2:
            paint_label(axes, right, up, f"{radius} m", "#6C757D")


def paint_label(axes: Axes, right: float, up: float, text: str, colour: str) -> None:
    """A length in metres on the ground, readable over what lies there."""
    axes.text(
        right, up, text, color=colour, fontsize=8.5, ha="center", va="center", zorder=6,
        bbox={"boxstyle": "square,pad=0.15", "fc": PANEL_COLOUR, "ec": "none", "alpha": 0.85},
    )  # fmt: skip


def paint_ego(axes: Axes) -> None:
    """The truck: origin under the rear axle, cab in front, a pale windscreen."""
    if axes.get_xlim()[1] > 75:
        axes.text(5, 0, "ego", color=INK, fontsize=8.5, va="center", zorder=6, clip_on=True)
    body = np.array([[-1.2, -1.25], [-1.2, 1.25], [6.0, 1.25], [6.0, -1.25]])
    screen = np.array([[5.0, -1.05], [5.0, 1.05], [5.7, 1.05], [5.7, -1.05]])
    axes.add_patch(Polygon(upright(body), facecolor=INK, edgecolor="white", linewidth=0.8, zorder=5))
    axes.add_patch(Polygon(upright(screen), facecolor="#BFE3F7", edgecolor="none", zorder=5.1))


def paint_occupancy(axes: Axes, scene: BevScene) -> None:
    """Splatted occupancy as a faint heat image on its cells."""
    if scene.occupancy is None:
        return
    grid, (cells, alpha) = scene.grid, scene.occupancy
    image = np.zeros((grid.cols, grid.rows, 4))  # up = column (x), right = falling row (-y)
    image[..., :3] = OCCUPANCY_COLOUR
    inside = ((cells >= 0) & (cells < (grid.rows, grid.cols))).all(axis=1)
    rows, cols = np.asarray(cells)[inside].astype(np.int64).T
    image[cols, grid.rows - 1 - rows, 3] = 0.75 * np.clip(np.nan_to_num(alpha[inside]), 0, 1)
    limits = axes.get_xlim(), axes.get_ylim()
    extent = (*grid.window[0], *grid.window[1])
    axes.imshow(image, extent=extent, origin="lower", interpolation="nearest", aspect="equal", zorder=1)
    axes.set_xlim(*limits[0])
    axes.set_ylim(*limits[1])


def radial_speeds(
    points: Array,  # [P, 7]
) -> Array:  # [P] m/s, positive = moving away
    """Signed length of the compensated radial velocity, as seen from the ego origin."""
    outward = (points[:, 4:6] * points[:, :2]).sum(axis=1)
    return np.sign(outward) * np.linalg.norm(points[:, 4:6], axis=1)


def paint_radar(axes: Axes, points: Array | None) -> None:
    """Standing points small and grey, moving ones by radial speed."""
    if points is None or len(points) == 0:
        return
    points = points[np.isfinite(points).all(axis=1)]
    speeds = radial_speeds(points)
    moving = np.abs(speeds) >= MOVING_MPS
    xy = upright(points[:, :2])
    size = 1.0 if axes.get_xlim()[1] > 75 else 2.2
    axes.plot(*xy[~moving].T, linestyle="none", marker=".", markersize=2 * size, color=STANDING_COLOUR, mew=0, zorder=2)
    colours = SPEED_COLOURS(Normalize(-SPEED_LIMIT_MPS, SPEED_LIMIT_MPS)(speeds[moving]))
    axes.scatter(*xy[moving].T, s=7 * size, c=colours, linewidths=0, zorder=2.2)


def paint_gaussians(axes: Axes, gaussians: PictureGaussians | None) -> None:
    """One-sigma ellipses in the colour of their source, filled by opacity; history dotted, rare sources on top."""
    if gaussians is None or len(gaussians) == 0:
        return
    outlines = upright(gaussians.outlines())
    keep = np.isfinite(outlines).all(axis=(1, 2)) & np.isfinite(gaussians.opacities)
    opacity = np.clip(gaussians.opacities, 0, 1)
    counts = np.bincount(gaussians.sources, minlength=len(SOURCES))
    for source in np.argsort(-counts):
        rows = np.flatnonzero(keep & (gaussians.sources == source))
        if len(rows) == 0:
            continue
        edge = np.tile(to_rgba(SOURCE_COLOURS[SOURCES[source]]), (len(rows), 1))
        face = edge.copy()
        edge[:, 3] = 0.4 + 0.6 * opacity[rows]
        face[:, 3] = 0.35 * opacity[rows]
        axes.add_collection(
            PolyCollection(outlines[rows], facecolors=face, edgecolors=edge, linewidths=0.9, zorder=2.5), autolim=False
        )
        if SOURCES[source] == "history":  # told apart from its neighbours by form as well
            dots = {"linestyle": "none", "marker": ".", "markersize": 3.2, "mew": 0, "zorder": 2.6}
            axes.plot(*upright(gaussians.means[rows]).T, color=SOURCE_COLOURS["history"], **dots)


def paint_footprints(axes: Axes, boxes: PictureBoxes, predicted: bool, arrows: bool = True) -> None:
    """Footprints, with a bar behind the front edge, small classes also as markers, and velocity arrows."""
    if len(boxes) == 0:
        return
    order = 4.0 if predicted else 4.4
    footprints = upright(boxes.corners()[:, :4, :2])  # [K, 4, 2]
    colours = np.array([to_rgba(colour if predicted else INK) for colour in boxes.colours()])
    faces = colours * (1, 1, 1, 0.30)
    if predicted:
        style = {"facecolors": faces, "edgecolors": colours, "linewidths": 1.7}
    else:
        style = {"facecolors": "none", "edgecolors": INK, "linewidths": 1.0, "linestyles": (0, (2.6, 1.6))}
    axes.add_collection(PolyCollection(footprints, zorder=order, **style), autolim=False)
    if predicted:
        axes.add_collection(LineCollection(footprints[:, :2], colors=colours, linewidths=3.2, zorder=order + 0.1))
    paint_markers(axes, boxes, predicted, order + 0.2)
    if arrows:
        moving = boxes.moving()
        style = (2.8, (3.6, 4.0, 3.6)) if predicted else (1.1, (6.0, 7.0, 3.6))
        order = order + 0.3 if predicted else 3.9  # truth shows where it differs
        paint_arrows(axes, boxes.centers[moving, :2], boxes.velocities[moving], colours[moving], *style, order)


def paint_markers(axes: Axes, boxes: PictureBoxes, predicted: bool, order: float) -> None:
    """Classes too small to be seen from above, each with its own marker: filled for predictions, hollow for truth."""
    size = 5.0 if predicted else 6.6
    for name, marker in CLASS_MARKERS.items():
        chosen = boxes.labels == CLASSES.index(name)
        if chosen.any():
            axes.plot(
                *upright(boxes.centers[chosen, :2]).T, linestyle="none", marker=marker, markersize=size, zorder=order,
                markerfacecolor=CLASS_COLOURS[name] if predicted else "none",
                markeredgecolor="white" if predicted else INK, markeredgewidth=0.5 if predicted else 1.0,
            )  # fmt: skip


def paint_arrows(
    axes: Axes,
    xy: Array,  # [n, 2] m
    velocities: Array,  # [n, 2] m/s
    colours: Array | str,
    width_px: float,
    head: tuple[float, float, float],  # width, length and length along the shaft, in widths
    order: float,
) -> None:
    """Arrows over the travel of ARROW_S seconds."""
    if len(xy):
        axes.quiver(
            *upright(xy).T, *(ARROW_S * upright(velocities)).T, color=colours, angles="xy", scale_units="xy", scale=1,
            units="dots", width=width_px, headwidth=head[0], headlength=head[1], headaxislength=head[2], zorder=order,
        )  # fmt: skip


def ring_missed(axes: Axes, scene: BevScene) -> None:
    """Circle the true boxes that no prediction found, so that misses catch the eye."""
    _, found = match_boxes(scene.predictions, scene.ground_truth)
    if len(scene.predictions) and not found.all():
        axes.plot(
            *upright(scene.ground_truth.centers[~found, :2]).T, linestyle="none", marker="o", markersize=15,
            markerfacecolor="none", markeredgecolor=MISSED_COLOUR, markeredgewidth=1.1, alpha=0.8, zorder=3.8,
        )  # fmt: skip


def paint_detections(axes: Axes, scene: BevScene) -> None:
    """Detections: radar (else LiDAR) points, true and predicted boxes with velocities."""
    if scene.radar_points is not None:
        paint_radar(axes, scene.radar_points)
    elif scene.lidar_points is not None:  # a pixel each: they are many
        axes.plot(*upright(scene.lidar_points[:, :2]).T, linestyle="none", marker=",", color=LIDAR_COLOUR, zorder=2)
    ring_missed(axes, scene)
    paint_footprints(axes, scene.predictions, predicted=True)
    paint_footprints(axes, scene.ground_truth, predicted=False)


def paint_evidence(axes: Axes, scene: BevScene) -> None:
    """Evidence: splatted occupancy and Gaussians by source, with the true boxes."""
    paint_occupancy(axes, scene)
    paint_gaussians(axes, scene.gaussians)
    paint_footprints(axes, scene.ground_truth, predicted=False, arrows=False)
