"""Pictures of the synthetic world: one key frame per scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from src.pictures.bev import bev_panel, paint_boxes, paint_radar
from src.pictures.cameras import PictureViews, cameras_height, paint_cameras
from src.pictures.canvas import CAPTION_PX, GAP_PX, HALF_PX, MARGIN_PX, SHEET_PX, Canvas
from src.pictures.contents import PictureBoxes
from src.pictures.legends import class_keys, radar_keys

Array = np.ndarray

HEADER_PX = 74
RANGE_M = 153.6
NEAR_M = 60.0


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
    top = HEADER_PX + camera_px + GAP_PX
    canvas = Canvas(SHEET_PX, round(top + 2 * (CAPTION_PX + HALF_PX) + GAP_PX))
    canvas.text(MARGIN_PX, 8, title, 20, bold=True)
    canvas.legend(MARGIN_PX, 44, class_keys(set(shown.labels.tolist())))
    paint_cameras(canvas, views, (MARGIN_PX, HEADER_PX, wide), shown, PictureBoxes.empty())
    for row, reach in enumerate((RANGE_M, NEAR_M)):
        high = top + row * (CAPTION_PX + HALF_PX) + CAPTION_PX
        window, size = ((-reach, reach), (-reach, reach)), f"±{reach:g} m"
        axes = bev_panel(canvas, (MARGIN_PX, high, HALF_PX, HALF_PX), window, f"Radar, {size}", radar_keys())
        paint_radar(axes, radar_points)
        paint_boxes(axes, shown, predicted=False, arrows=False)
        caption = f"Ground truth, {size}, arrows: travel in 0.5 s"
        axes = bev_panel(canvas, (MARGIN_PX + HALF_PX + GAP_PX, high, HALF_PX, HALF_PX), window, caption)
        paint_boxes(axes, shown, predicted=True)
    canvas.save(path)
