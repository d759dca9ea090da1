"""One frame on one sheet: camera images, detections, and the Gaussians and occupancy behind them."""

from __future__ import annotations

from pathlib import Path

from src.pictures.bev import BevScene, bev_panel, paint_detections, paint_evidence
from src.pictures.cameras import PictureViews, cameras_height, paint_cameras
from src.pictures.canvas import CAPTION_PX, GAP_PX, HALF_PX, MARGIN_PX, SHEET_PX, Canvas
from src.pictures.contents import MUTED, Window, match_boxes
from src.pictures.legends import class_keys, gaussian_keys, point_keys, reading_keys

HEADER_PX = 112
NEAR_PX = 500
NEAR_PX_PER_M = 8.0
NEAR_BEHIND_SHARE = 0.35
"""Share of the near view that lies behind the ego's rear axle."""


def counts_line(scene: BevScene, score_threshold: float) -> str:
    """Numbers of boxes, matches, misses and false positives; of predictions alone where there is no ground truth."""
    predictions, truth = scene.predictions, scene.ground_truth
    if predictions.scores is None:
        return f"{len(predictions)} true boxes"
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
    canvas.legend(MARGIN_PX, 66, reading_keys(missed, truth_alone=scene.predictions.scores is None))
    canvas.legend(MARGIN_PX, 89, class_keys({*scene.predictions.labels, *scene.ground_truth.labels}))


def near_window(width: float, height: float) -> Window:
    """Plot window (right, up) of the close surroundings in a panel of this size, m."""
    wide, high = width / NEAR_PX_PER_M, height / NEAR_PX_PER_M
    return (-wide / 2, wide / 2), (-NEAR_BEHIND_SHARE * high, (1 - NEAR_BEHIND_SHARE) * high)


def bev_height(scene: BevScene) -> int:
    """Height in picture pixels of all BEV panels."""
    whole = CAPTION_PX + HALF_PX * scene.grid.cols / scene.grid.rows
    return round(whole + (CAPTION_PX + NEAR_PX if has_evidence(scene) else 0))


def has_evidence(scene: BevScene) -> bool:
    """Whether the model gave Gaussians or occupancy to show."""
    return scene.gaussians is not None or scene.occupancy is not None


def paint_bev(canvas: Canvas, scene: BevScene, top: float) -> None:
    """Detections and, where there are any, Gaussians and occupancy: over the whole grid and close to the ego.

    Left column detections, right column Gaussians, the near views below; without Gaussians the near view takes the
    right column.
    """
    wide, high = HALF_PX, HALF_PX * scene.grid.cols / scene.grid.rows
    right, top = MARGIN_PX + wide + GAP_PX, top + CAPTION_PX
    whole = scene.grid.window
    paint_detections(bev_panel(canvas, (MARGIN_PX, top, wide, high), whole, "Detections", point_keys(scene)), scene)
    canvas.text(MARGIN_PX + wide, top - CAPTION_PX + 12, "forward is up", 12, colour=MUTED, align="right")
    if not has_evidence(scene):
        axes = bev_panel(canvas, (right, top, wide, high), near_window(wide, high), "Detections close up")
        paint_detections(axes, scene)
        return
    name = "Gaussians" if scene.gaussians is not None else "Occupancy"
    paint_evidence(bev_panel(canvas, (right, top, wide, high), whole, name, gaussian_keys(scene)), scene)
    below, near = top + high + CAPTION_PX, near_window(wide, NEAR_PX)
    paint_detections(bev_panel(canvas, (MARGIN_PX, below, wide, NEAR_PX), near, "Detections close up"), scene)
    paint_evidence(bev_panel(canvas, (right, below, wide, NEAR_PX), near, f"{name} close up"), scene)


def draw_frame(
    path: Path | str,
    scene: BevScene,
    views: PictureViews | None = None,
    title: str = "",
    score_threshold: float = 0.0,
) -> None:
    """Write one PNG, SHEET_PX wide: header with counts and legend, cameras with projected boxes, BEV panels.

    Everything is in ego metres; forward is up in the BEV. Predictions below the score threshold, and boxes or points
    that are not finite, are left out. Predictions without scores are true boxes, to be seen in the colours of their
    classes. Raises OSError when the file cannot be written.
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
