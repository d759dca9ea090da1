"""Camera images with the boxes projected into them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgba

from src.pictures.canvas import Canvas
from src.pictures.contents import BOX_EDGES, FRONT_FACE, INK, MUTED, PictureBoxes
from src.structures.taxonomy import CLASSES

Array = np.ndarray

NEAR_M = 0.2
"""Depth of the clipping plane; what lies nearer, or behind the camera, is cut off."""

GAP_PX = 8
DEFAULT_ASPECT = 864 / 256
LABEL_PX = 12
MIN_LABELLED_PX = 16


@dataclass
class PictureViews:
    """N cameras of one frame."""

    images: Sequence[Array | None]  # N of [H, W, 3] uint8 RGB, None where the camera gave no image
    pix_from_ego: Array  # [N, 4, 4], rows 0-2: ego metres -> (u*d, v*d, d); pixel centres lie at +0.5
    names: Sequence[str]  # N channel names, e.g. CAMERA_LEFT_FRONT

    def __len__(self) -> int:
        return len(self.images)

    def order(self) -> list[int]:
        """Cameras in the order of the sheet: front before back, left before right."""
        return sorted(range(len(self)), key=lambda i: ("FRONT" not in self.names[i], "LEFT" not in self.names[i]))

    @property
    def aspect(self) -> float:
        """Width over height of the first image there is."""
        return next((image.shape[1] / image.shape[0] for image in self.images if image is not None), DEFAULT_ASPECT)


def border_distances(
    points: Array,  # [..., 3] (u*d, v*d, d)
    width: float,
    height: float,
) -> Array:  # [..., 5], inside where >= 0
    """Distances of points to the planes that bound what an image shows, the first being depth - NEAR_M.

    In these homogeneous coordinates projection is linear in 3D, so clipping before the division is exact even for
    an edge that ends behind the camera.
    """
    planes = np.array([[0, 0, 1], [1, 0, 0], [-1, 0, width], [0, 1, 0], [0, -1, height]], dtype=np.float64)
    return points @ planes.T - np.array([NEAR_M, 0, 0, 0, 0])


def clip_edges(
    edges: Array,  # [E, 2, 3] end points (u*d, v*d, d)
    width: float,
    height: float,
) -> tuple[Array, Array]:  # [V, 2, 2] pixels, [V] index of the edge each visible piece came from
    """The pieces of straight 3D edges that an image of this size shows, in pixels."""
    distance = border_distances(edges, width, height)  # [E, 2, 5]
    start, end = distance[:, 0], distance[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = start / (start - end)  # only read where the signs differ
    enter = np.where((start < 0) & (end >= 0), crossing, 0.0).max(axis=1)
    leave = np.where((start >= 0) & (end < 0), crossing, 1.0).min(axis=1)
    visible = ((start >= 0) | (end >= 0)).all(axis=1) & (enter < leave)
    first, last = edges[visible, 0], edges[visible, 1]
    at = np.stack([enter[visible], leave[visible]], axis=1)[..., None]  # [V, 2, 1]
    pieces = first[:, None] + at * (last - first)[:, None]  # [V, 2, 3]
    return pieces[..., :2] / pieces[..., 2:], np.flatnonzero(visible)


def clip_polygon(
    polygon: Array,  # [n, 3] (u*d, v*d, d)
    width: float,
    height: float,
) -> Array:  # [m, 2] pixels, m = 0 where nothing is visible
    """The part of a plane convex polygon that an image of this size shows (Sutherland & Hodgman 1974), in pixels."""
    for index in range(5):
        distance = border_distances(polygon, width, height)[:, index]
        kept = []
        for i in range(len(polygon)):
            j = (i + 1) % len(polygon)
            if distance[i] >= 0:
                kept.append(polygon[i])
            if (distance[i] >= 0) != (distance[j] >= 0):
                kept.append(polygon[i] + distance[i] / (distance[i] - distance[j]) * (polygon[j] - polygon[i]))
        polygon = np.array(kept).reshape(-1, 3)
    return polygon[:, :2] / polygon[:, 2:]


def project_corners(boxes: PictureBoxes, pix_from_ego: Array) -> Array:  # [K, 8, 3]
    """Corners of K boxes as homogeneous pixels (u*d, v*d, d); `pix_from_ego` [4, 4]."""
    return boxes.corners() @ pix_from_ego[:3, :3].T + pix_from_ego[:3, 3]


def paint_wireframes(
    axes: Axes,
    boxes: PictureBoxes,
    pix_from_ego: Array,  # [4, 4]
    size: tuple[int, int],  # (width, height) px
    predicted: bool,
) -> None:
    """Add the visible edges: predictions solid in class colours with a tinted front face, truth dashed on a halo."""
    corners = project_corners(boxes, pix_from_ego)
    edges = corners[:, BOX_EDGES, :]  # [K, 12, 2, 3]
    pieces, rows = clip_edges(edges.reshape(-1, 2, 3), *size)
    depth = np.maximum(corners[:, :, 2].mean(axis=1), NEAR_M)
    weight = np.clip(1.25 - depth / 90, 0.45, 1.1)[rows // len(BOX_EDGES)]  # far boxes are small: finer lines
    if not predicted:
        axes.add_collection(LineCollection(pieces, colors=INK, linewidths=2.1 * weight, alpha=0.5), autolim=False)
        dashes = LineCollection(pieces, colors="white", linewidths=1.0 * weight, linestyles=(0, (4.0, 2.2)))
        axes.add_collection(dashes, autolim=False)
        return
    colours = np.array([to_rgba(colour) for colour in boxes.colours()]).reshape(-1, 4)
    faces = [clip_polygon(box[list(FRONT_FACE)], *size) for box in corners]
    shown = [row for row, face in enumerate(faces) if len(face)]
    fronts = PolyCollection([faces[row] for row in shown], facecolors=colours[shown], edgecolors="none", alpha=0.38)
    axes.add_collection(fronts, autolim=False)
    axes.add_collection(LineCollection(pieces, colors="white", linewidths=3.4 * weight, alpha=0.6), autolim=False)
    solid = LineCollection(pieces, colors=colours[rows // len(BOX_EDGES)], linewidths=2.0 * weight)
    axes.add_collection(solid, autolim=False)
    paint_labels(axes, boxes, pieces, rows // len(BOX_EDGES), size)


def paint_labels(
    axes: Axes,
    boxes: PictureBoxes,
    pieces: Array,  # [V, 2, 2] px, visible edges
    owners: Array,  # [V] box of each edge
    size: tuple[int, int],  # (width, height) px
) -> None:
    """Write class and score above the boxes that are large enough, strongest first, none over another."""
    width, height = size
    scale = width / axes.bbox.width  # image pixels per picture pixel
    taken: list[tuple[float, float, float, float]] = [(0, 0, 150 * scale, 26 * scale)]  # the camera's name
    for row in range(len(boxes) - 1, -1, -1):
        points = pieces[owners == row].reshape(-1, 2)
        if len(points) == 0 or np.ptp(points[:, 1]) < MIN_LABELLED_PX * scale:
            continue
        name = CLASSES[boxes.labels[row]].replace("_", " ")
        text = name if boxes.scores is None else f"{name} {boxes.scores[row]:.2f}"
        wide, high = (0.62 * len(text) + 0.5) * LABEL_PX * scale, 1.5 * LABEL_PX * scale
        left = float(np.clip(points[:, 0].min(), 0, max(width - wide, 0)))
        top = float(np.clip(points[:, 1].min() - high - 2 * scale, 0, height - high))
        area = (left, top, left + wide, top + high)
        if any(area[0] < t[2] and t[0] < area[2] and area[1] < t[3] and t[1] < area[3] for t in taken):
            continue
        taken.append(area)
        axes.text(
            left + wide / 2, top + high / 2, text, color="white", fontsize=LABEL_PX * 0.72, ha="center", va="center",
            parse_math=False, bbox={"boxstyle": "square,pad=0.18", "fc": boxes.colours()[row], "ec": "none"},
        )  # fmt: skip


def paint_camera(
    axes: Axes,
    image: Array | None,  # [H, W, 3] uint8
    pix_from_ego: Array,  # [4, 4]
    name: str,
    predictions: PictureBoxes,
    ground_truth: PictureBoxes,
) -> None:
    """Fill the axes with one camera."""
    caption = name.removeprefix("CAMERA_").replace("_", " ").lower()
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)
    if image is None:
        axes.set_facecolor("#E4E7EA")
        axes.text(
            0.5, 0.5, f"{caption}: no image", transform=axes.transAxes, ha="center", va="center", color=MUTED,
            fontsize=12, parse_math=False,
        )  # fmt: skip
        return
    height, width = image.shape[:2]
    axes.imshow(image, extent=(0, width, height, 0), aspect="auto", interpolation="antialiased")
    axes.set_xlim(0, width)
    axes.set_ylim(height, 0)
    paint_wireframes(axes, predictions, pix_from_ego, (width, height), predicted=True)
    paint_wireframes(axes, ground_truth, pix_from_ego, (width, height), predicted=False)
    axes.text(
        0.008, 0.975, caption, transform=axes.transAxes, ha="left", va="top", color="white", fontsize=9.5,
        fontweight="bold", parse_math=False,
        bbox={"boxstyle": "square,pad=0.3", "fc": INK, "ec": "none", "alpha": 0.75},
    )  # fmt: skip


def cameras_height(
    views: PictureViews,
    width: int,
) -> int:
    """Height in picture pixels of all cameras, two to a row."""
    rows = (len(views) + 1) // 2
    each = _camera_width(views, width) / views.aspect
    return round(rows * each + max(rows - 1, 0) * GAP_PX)


def _camera_width(views: PictureViews, width: int) -> float:
    return width if len(views) == 1 else (width - GAP_PX) / 2


def paint_cameras(
    canvas: Canvas,
    views: PictureViews,
    area: tuple[float, float, float],  # left, top, width in picture pixels
    predictions: PictureBoxes,
    ground_truth: PictureBoxes,
) -> None:
    """Place the cameras two to a row: left and right front, then left and right back."""
    left, top, width = area
    wide = _camera_width(views, int(width))
    high = wide / views.aspect
    for place, index in enumerate(views.order()):
        row, column = divmod(place, 2)
        axes = canvas.axes(left + column * (wide + GAP_PX), top + row * (high + GAP_PX), wide, high)
        paint_camera(
            axes, views.images[index], views.pix_from_ego[index], views.names[index], predictions, ground_truth
        )
