"""Pictures of the synthetic world."""

import numpy as np
import pytest
from PIL import Image

from src.pictures.cameras import PictureViews
from src.pictures.contents import PictureBoxes
from src.pictures.scene_preview import draw_scene_preview
from src.structures.taxonomy import CAMERAS


def a_box(x, y, velocity):
    return PictureBoxes(
        np.array([[x, y, 1.0]]), np.array([[4.5, 1.9, 1.5]]), np.zeros(1), np.array([velocity]), np.zeros(1)
    )


def preview(path, boxes, points):
    image = np.full((40, 80, 3), 90, dtype=np.uint8)
    views = PictureViews([image] * 4, np.tile(np.eye(4), (4, 1, 1)), CAMERAS)
    draw_scene_preview(path, views, boxes, points, "a scene")
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


@pytest.mark.slow
def test_preview_shows_radar_boxes_and_arrows(tmp_path):
    nothing = preview(tmp_path / "a.png", PictureBoxes.empty(), np.zeros((0, 7)))
    radar = preview(tmp_path / "b.png", PictureBoxes.empty(), np.array([[40.0, 0, 1, 5, 20.0, 0, 0]]))
    standing = preview(tmp_path / "c.png", a_box(20.0, 3.0, [0.0, 0.0]), np.zeros((0, 7)))
    moving = preview(tmp_path / "d.png", a_box(20.0, 3.0, [30.0, 0.0]), np.zeros((0, 7)))
    assert nothing.shape[1] == 1600
    half = nothing.shape[1] // 2
    changed = np.abs(radar - nothing).sum(2) > 60
    assert changed[:, :half].any() and not changed[:, half:].any()  # radar stands on the left
    arrow = np.abs(moving - standing).sum(2) > 60
    assert arrow[:, half:].sum() > 50 and not arrow[:, :half].any()
