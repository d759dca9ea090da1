"""One frame on one sheet: camera images, detections, and the Gaussians and occupancy behind them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from matplotlib.artist import Artist
from matplotlib.axes import Axes

from src.pictures.bev import BevScene, paint_detections, paint_evidence
from src.pictures.cameras import PictureViews, cameras_height, paint_cameras
from src.pictures.canvas import SHEET_PX, Canvas
from src.pictures.contents import MUTED, match_boxes
from src.pictures.legends import class_keys, gaussian_keys, radar_keys, reading_keys

MARGIN_PX = 10
GAP_PX = 12
HEADER_PX = 112
CAPTION_PX = 34
NEAR_PX = 500
NEAR_PX_PER_M = 8.0
NEAR_BEHIND_SHARE = 0.35
"""Share of the near view that lies behind the ego's rear axle."""

Painter = Callable[[Axes, BevScene, tuple[float, float], tuple[float, float]], None]
Window = tuple[tuple[float, float], tuple[float, float]]


def counts_line(scene: BevScene, score_threshold: float) -> str:
    """Numbers of boxes, matches, misses and false positives; of predictions alone where there is no ground truth."""
    predictions, truth = scene.predictions, scene.ground_truth
    line = f"{len(predictions)} predictions (score ≥ {score_threshold:.2f})"
    if len(truth) == 0:
        return f"{line}   ·   no ground truth"
    matched = int(match_boxes(predictions, truth)[0].sum())
    parts = [f"{len(truth)} ground truth", line, f"{matched} matched within 2 m", f"{len(truth) - matched} missed"]
    return "   ·   ".join([*parts, f"{len(predictions) - matched} false"])


def paint_header(canvas: Canvas, scene: BevScene, title: str, score_threshold: float) -> None:
    """Title, counts and the legend that cameras and BEV share, in the top HEADER_PX pixels."""
    canvas.text(MARGIN_PX, 8, title if len(title) <= 110 else f"{title[:109]}…", 22, bold=True)
    canvas.text(MARGIN_PX, 40, counts_line(scene, score_threshold), 15)
    missed = not match_boxes(scene.predictions, scene.ground_truth)[1].all() and len(scene.predictions) > 0
    canvas.legend(MARGIN_PX, 66, reading_keys(missed))
    canvas.legend(MARGIN_PX, 89, class_keys({*scene.predictions.labels, *scene.ground_truth.labels}))


def whole_window(scene: BevScene) -> Window:
    """Plot window (right, up) of the whole grid, m."""
    grid = scene.grid
    return (-grid.y_max_m, -grid.y_min_m), (grid.x_min_m, grid.x_max_m)


def near_window(width: float, height: float) -> Window:
    """Plot window (right, up) of the close surroundings in a panel of this size, m."""
    wide, high = width / NEAR_PX_PER_M, height / NEAR_PX_PER_M
    return (-wide / 2, wide / 2), (-NEAR_BEHIND_SHARE * high, (1 - NEAR_BEHIND_SHARE) * high)


def paint_panel(
    canvas: Canvas,
    area: tuple[float, float, float, float],  # left, top, width, height in picture pixels, caption included
    painter: Painter,
    scene: BevScene,
    window: Window,
    caption: str,
    keys: Sequence[Artist],
) -> None:
    """One BEV with its caption and keys above it."""
    left, top, width, height = area
    canvas.text(left, top + 9, caption, 15, bold=True)
    canvas.legend(left + 10 + 9.2 * len(caption), top + 11, keys, size_px=12)
    painter(canvas.axes(left, top + CAPTION_PX, width, height - CAPTION_PX), scene, *window)


def bev_height(scene: BevScene) -> int:
    """Height in picture pixels of all BEV panels."""
    wide = (SHEET_PX - 2 * MARGIN_PX - GAP_PX) / 2
    whole = CAPTION_PX + wide * scene.grid.cols / scene.grid.rows
    return round(whole + (CAPTION_PX + NEAR_PX if has_evidence(scene) else 0))


def has_evidence(scene: BevScene) -> bool:
    """Whether the model gave Gaussians or occupancy to show."""
    return scene.gaussians is not None or scene.occupancy is not None


def paint_bev(canvas: Canvas, scene: BevScene, top: float) -> None:
    """Detections and, where there are any, Gaussians and occupancy: over the whole grid and close to the ego.

    Left column detections, right column Gaussians, the near views below; without Gaussians the near view takes the
    right column.
    """
    wide = (SHEET_PX - 2 * MARGIN_PX - GAP_PX) / 2
    high = wide * scene.grid.cols / scene.grid.rows
    right = MARGIN_PX + wide + GAP_PX
    whole_area = (MARGIN_PX, top, wide, high + CAPTION_PX)
    paint_panel(canvas, whole_area, paint_detections, scene, whole_window(scene), "Detections", radar_keys())
    canvas.text(MARGIN_PX + wide, top + 12, "forward is up", 12, colour=MUTED, align="right")
    if not has_evidence(scene):
        area = (right, top, wide, high + CAPTION_PX)
        paint_panel(canvas, area, paint_detections, scene, near_window(wide, high), "Detections close up", [])
        return
    name = "Gaussians" if scene.gaussians is not None else "Occupancy"
    area = (right, top, wide, high + CAPTION_PX)
    paint_panel(canvas, area, paint_evidence, scene, whole_window(scene), name, gaussian_keys(scene))
    below, near = top + high + CAPTION_PX, near_window(wide, NEAR_PX)
    area = (MARGIN_PX, below, wide, NEAR_PX + CAPTION_PX)
    paint_panel(canvas, area, paint_detections, scene, near, "Detections close up", [])
    area = (right, below, wide, NEAR_PX + CAPTION_PX)
    paint_panel(canvas, area, paint_evidence, scene, near, f"{name} close up", [])


def draw_frame(
    path: Path | str,
    scene: BevScene,
    views: PictureViews | None = None,
    title: str = "",
    score_threshold: float = 0.0,
) -> None:
    """Write one PNG, SHEET_PX wide: header with counts and legend, cameras with projected boxes, BEV panels.

    Everything is in ego metres; forward is up in the BEV. Predictions below the score threshold, and boxes or points
    that are not finite, are left out. Raises OSError when the file cannot be written.
    """
    shown = scene.drawable(score_threshold)
    seen = views is not None and len(views) > 0
    wide = SHEET_PX - 2 * MARGIN_PX
    camera_px = cameras_height(views, wide) if seen else 0
    canvas = Canvas(SHEET_PX, HEADER_PX + camera_px + bev_height(scene) + MARGIN_PX)
    paint_header(canvas, shown, title, score_threshold)
    if seen:
        paint_cameras(canvas, views, (MARGIN_PX, HEADER_PX, wide), shown.predictions, shown.ground_truth)
    paint_bev(canvas, shown, HEADER_PX + camera_px)
    canvas.save(path)


def draw_bev(
    path: Path | str,
    scene: BevScene,
    title: str = "",
    score_threshold: float = 0.0,
) -> None:
    """Write one PNG of the BEV panels with header, as `draw_frame` without cameras."""
    draw_frame(path, scene, None, title, score_threshold)
