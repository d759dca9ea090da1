"""Sheets of a gallery: whole frames, or the surroundings of single boxes, each as several runs see it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.lines import Line2D

from src.pictures.bev import BevScene, frame_ground, paint_detections, paint_ego, upright
from src.pictures.cameras import PictureViews, clip_edges, paint_camera, paint_wireframes, project_corners
from src.pictures.canvas import GAP_PX, HALF_PX, MARGIN_PX, SHEET_PX, Canvas
from src.pictures.contents import BOX_EDGES, INK, MUTED, PictureBoxes, Window, match_boxes
from src.pictures.legends import class_keys, radar_keys, reading_keys

HEADER_PX = 84
TITLE_PX = 26
"""Height above a cell, for its title."""
FRAME_WINDOW: Window = ((-60.0, 60.0), (-30.0, 130.0))
AROUND_M = 20.0
"""Ground shown to each side of a box that is looked at."""
CROP_SIZES = 2.5
"""Half the size of an image crop, in heights of the box."""
MIN_CROP_PX = 24.0
NAME_PX, ADVANCE = 13, 0.6
"""Height of a panel's name where it fits, and the mean width of a letter in heights."""
LINE_PX = 18
MARK_COLOUR = "#FFD60A"
"""Of the box that is looked at, below all others."""


@dataclass
class GalleryFrame:
    """One frame as each of several runs sees it; scenes differ in their predictions alone."""

    title: str
    scenes: list[BevScene]
    views: PictureViews | None
    box: PictureBoxes | None = None  # the one that is looked at


def draw_whole_frames(
    path: Path, title: str, frames: Sequence[GalleryFrame], names: Sequence[str], score: float
) -> None:
    """Front cameras with the boxes of the last run, below them the road ahead, a panel for each run by its name."""
    cell = _cell_width(frames)
    wide = (cell - GAP_PX * (len(names) - 1)) / len(names)
    (left, right), (down, up) = FRAME_WINDOW
    high = wide * (up - down) / (right - left)
    camera = (cell - GAP_PX) / 2
    cameras_px = max((camera / frame.views.aspect for frame in frames if frame.views is not None), default=0.0)
    names_px = cameras_px + 4 + 2 * LINE_PX

    def paint(canvas: Canvas, frame: GalleryFrame, left: float, top: float) -> None:
        if frame.views is not None:
            last = frame.scenes[-1]
            for place, index in enumerate(frame.views.order()[:2]):
                axes = canvas.axes(left + place * (camera + GAP_PX), top, camera, camera / frame.views.aspect)
                image, name = frame.views.images[index], frame.views.names[index]
                paint_camera(axes, image, frame.views.pix_from_ego[index], name, last.predictions, last.ground_truth)
        for place, scene in enumerate(frame.scenes):
            axes = _panel(canvas, left + place * (wide + GAP_PX), top + names_px, wide, high, FRAME_WINDOW)
            paint_detections(axes, scene)
            predictions, truth = scene.predictions, scene.ground_truth
            found, matched = (int(rows.sum()) for rows in match_boxes(predictions, truth))
            counts = f"{matched} of {len(truth)} found, {len(predictions) - found} false"
            for line, text in enumerate((names[place], counts)):
                at = left + place * (wide + GAP_PX), top + cameras_px + 4 + line * LINE_PX
                canvas.text(*at, text, _fitting(text, wide), colour=MUTED if line else INK)

    _draw_cells(path, title, frames, names_px + high, score, right - left, paint)


def draw_boxes(path: Path, title: str, frames: Sequence[GalleryFrame], names: Sequence[str], score: float) -> None:
    """The part of an image with each frame's `box` and the boxes of the last run, beside it the ground around it."""
    side = (_cell_width(frames) - GAP_PX * len(names)) / (len(names) + 1)

    def paint(canvas: Canvas, frame: GalleryFrame, left: float, top: float) -> None:
        top += LINE_PX
        _paint_crop(canvas.axes(left, top, side, side), frame)
        right, up = upright(frame.box.centers[0, :2])
        window = (right - AROUND_M, right + AROUND_M), (up - AROUND_M, up + AROUND_M)
        for place, scene in enumerate(frame.scenes, start=1):
            at = left + place * (side + GAP_PX)
            axes = _panel(canvas, at, top, side, side, window)
            footprint = upright(frame.box.corners()[:, :4, :2])
            mark = PolyCollection(footprint, facecolors="none", edgecolors=MARK_COLOUR, linewidths=8, zorder=3.5)
            axes.add_collection(mark, autolim=False)
            paint_detections(axes, scene)
            canvas.text(at, top - 19, names[place - 1], _fitting(names[place - 1], side))

    mark = Line2D([], [], color=MARK_COLOUR, linewidth=6, label="looked at")
    _draw_cells(path, title, frames, LINE_PX + side, score, 2 * AROUND_M, paint, mark)


def _draw_cells(
    path: Path,
    title: str,
    frames: Sequence[GalleryFrame],
    height: float,  # of a cell without its title, px
    score: float,
    wide_m: float,  # ground that a panel shows from left to right
    paint: Callable[[Canvas, GalleryFrame, float, float], None],
    *keys: Artist,
) -> None:
    """Cells two to a row, below a header with the legends."""
    step = TITLE_PX + height + GAP_PX
    canvas = Canvas(SHEET_PX, round(HEADER_PX + step * -(-len(frames) // 2) + MARGIN_PX))
    canvas.text(MARGIN_PX, 8, title, 20, bold=True)
    shown = [frame.scenes[-1] for frame in frames]
    labels = {label for scene in shown for label in (*scene.predictions.labels, *scene.ground_truth.labels)}
    canvas.legend(MARGIN_PX, 36, [*keys, *reading_keys(missed=True, truth_alone=False), *radar_keys()], size_px=12)
    canvas.legend(MARGIN_PX, 59, class_keys(labels), size_px=12)
    note = f"score ≥ {score:.2f}; forward is up; BEV {wide_m:g} m wide"
    canvas.text(SHEET_PX - MARGIN_PX, 12, note, 12, colour=MUTED, align="right")
    for place, frame in enumerate(frames):
        row, column = divmod(place, 2)
        left, top = MARGIN_PX + column * (HALF_PX + GAP_PX), HEADER_PX + row * step
        canvas.text(left, top + 4, frame.title, 14, bold=True)
        paint(canvas, frame, left, top + TITLE_PX)
    canvas.save(path, photographs=False)


def _fitting(text: str, width: float) -> float:  # px
    """The height at which a panel's name is no wider than the panel."""
    return min(NAME_PX, width / (ADVANCE * max(len(text), 1)))


def _cell_width(frames: Sequence[GalleryFrame]) -> float:
    """Width of a cell in pixels; a single one takes the whole sheet."""
    return HALF_PX if len(frames) > 1 else SHEET_PX - 2 * MARGIN_PX


def _panel(canvas: Canvas, left: float, top: float, width: float, height: float, window: Window) -> Axes:
    axes = canvas.axes(left, top, width, height)
    frame_ground(axes, window)
    paint_ego(axes)
    return axes


def _paint_crop(axes: Axes, frame: GalleryFrame) -> None:
    """The box in the camera that shows it largest; a grey field where none does."""
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_facecolor("#E4E7EA")
    best = (0.0, 0.0, 0.0, -1)  # height, u, v (px), camera
    for index, image in enumerate(frame.views.images if frame.views is not None else ()):
        matrix = frame.views.pix_from_ego[index]
        (corners,) = project_corners(frame.box, matrix)
        if image is None or (corners[:, 2] <= 0).any():
            continue
        pixels = corners[:, :2] / corners[:, 2:]
        u, v = pixels.mean(axis=0)
        if 0 <= u < image.shape[1] and 0 <= v < image.shape[0]:
            best = max(best, (float(np.ptp(pixels[:, 1])), float(u), float(v), index))
    height, u, v, index = best
    if index < 0:
        axes.text(0.5, 0.5, "in no image", transform=axes.transAxes, ha="center", va="center", color=MUTED, fontsize=11)
        return
    image, matrix, scene = frame.views.images[index], frame.views.pix_from_ego[index], frame.scenes[-1]
    size, half = (image.shape[1], image.shape[0]), max(CROP_SIZES * height, MIN_CROP_PX)
    axes.imshow(image, extent=(0, size[0], size[1], 0), aspect="auto", interpolation="nearest")
    edges, _ = clip_edges(project_corners(frame.box, matrix)[:, BOX_EDGES, :].reshape(-1, 2, 3), *size)
    axes.add_collection(LineCollection(edges, colors=MARK_COLOUR, linewidths=6, alpha=0.8), autolim=False)
    paint_wireframes(axes, scene.predictions, matrix, size, predicted=True)
    paint_wireframes(axes, scene.ground_truth, matrix, size, predicted=False)
    for text in axes.texts:
        text.remove()  # labels are placed for the whole image
    axes.set_xlim(u - half, u + half)
    axes.set_ylim(v + half, v - half)
