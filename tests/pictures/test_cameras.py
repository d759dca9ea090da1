"""Projection and drawing of boxes in camera images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

from src.pictures.cameras import NEAR_M, PictureViews, cameras_height, clip_edges, clip_polygon, paint_cameras
from src.pictures.canvas import SHEET_PX, Canvas
from src.pictures.contents import CLASS_COLOURS, PictureBoxes
from src.structures.taxonomy import CLASSES

WIDTH, HEIGHT, FOCAL = 1600, 400, 400.0
GREY = 120


def forward_camera() -> np.ndarray:
    """pix_from_ego of a camera at the ego origin that looks along +x: u = 800 - 400 y / x, v = 200 - 400 z / x."""
    return np.array([[WIDTH / 2, -FOCAL, 0, 0], [HEIGHT / 2, 0, -FOCAL, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])


def one_box(center: tuple, size: tuple, yaw: float = 0.0, score: float | None = None) -> PictureBoxes:
    return PictureBoxes([center], [size], [yaw], [(0, 0)], [CLASSES.index("car")], None if score is None else [score])


def draw_cameras(path: Path, views: PictureViews, predictions: PictureBoxes, truth: PictureBoxes) -> None:
    canvas = Canvas(SHEET_PX, cameras_height(views, SHEET_PX))
    paint_cameras(canvas, views, (0, 0, SHEET_PX), predictions, truth)
    canvas.save(path)


def render(tmp_path: Path, predictions: PictureBoxes, truth: PictureBoxes, threshold: float = 0.0) -> np.ndarray:
    """A single camera of the sheet's width: one image pixel is one picture pixel."""
    image = np.full((HEIGHT, WIDTH, 3), GREY, np.uint8)
    views = PictureViews([image], forward_camera()[None], ["CAMERA_LEFT_FRONT"])
    draw_cameras(tmp_path / "cameras.png", views, predictions.drawable(threshold), truth.drawable())
    return np.asarray(Image.open(tmp_path / "cameras.png").convert("RGB")).astype(int)


def changed(picture: np.ndarray) -> np.ndarray:
    """Where something was drawn, apart from the camera's name in the upper left corner."""
    mask = (np.abs(picture - GREY) > 8).any(axis=2)
    mask[:30, :160] = False
    return mask


def extent(mask: np.ndarray) -> tuple[int, int, int, int]:
    rows, cols = np.nonzero(mask)
    return cols.min(), cols.max(), rows.min(), rows.max()


def test_box_lands_on_hand_computed_pixels(tmp_path: Path) -> None:
    # Front face at x = 18, back at x = 22, y and z within +-1: the near square is 800 +- 400/18 wide.
    picture = render(tmp_path, PictureBoxes.empty(), one_box((20, 0, 0), (4, 2, 2), np.pi))
    assert picture.shape == (HEIGHT, WIDTH, 3)
    left, right, top, bottom = extent(changed(picture))
    reach = FOCAL / 18
    assert (left, right) == pytest.approx((800 - reach, 800 + reach), abs=2.5)
    assert (top, bottom) == pytest.approx((200 - reach, 200 + reach), abs=2.5)


def test_off_centre_box_is_not_mirrored(tmp_path: Path) -> None:
    # y = +5 is left, z = +2 is up: around (800 - 100, 200 - 40).
    left, right, top, bottom = extent(changed(render(tmp_path, PictureBoxes.empty(), one_box((20, 5, 2), (1, 1, 1)))))
    assert (left + right) / 2 == pytest.approx(700, abs=4)
    assert (top + bottom) / 2 == pytest.approx(160, abs=4)


def test_prediction_has_class_colour_and_tinted_front(tmp_path: Path) -> None:
    blue = np.array(to_rgb(CLASS_COLOURS["car"])) * 255
    # Near face at x = 4: 800 +- 100; far face at x = 8: 800 +- 50.
    facing = render(tmp_path, one_box((6, 0, 0), (4, 2, 2), np.pi, score=0.9), PictureBoxes.empty())
    assert np.abs(facing[200, 898:903] - blue).sum(axis=1).min() < 60
    away = render(tmp_path, one_box((6, 0, 0), (4, 2, 2), 0.0, score=0.9), PictureBoxes.empty())
    tinted = [changed(picture)[190, [825, 875]].tolist() for picture in (facing, away)]
    assert tinted == [[True, True], [True, False]]


def test_score_threshold_and_non_finite_boxes(tmp_path: Path) -> None:
    weak = one_box((20, 0, 0), (4, 2, 2), score=0.2)
    assert not changed(render(tmp_path, weak, PictureBoxes.empty(), 0.3)).any()
    assert changed(render(tmp_path, weak, PictureBoxes.empty(), 0.2)).any()
    broken = one_box((np.nan, 0, 0), (4, 2, 2), score=0.9)
    assert not changed(render(tmp_path, broken, one_box((20, 0, 0), (np.inf, 2, 2)))).any()


def test_boxes_behind_the_camera_are_not_drawn(tmp_path: Path) -> None:
    behind = one_box((-20, 0, 0), (4, 2, 2), score=0.9)
    assert not changed(render(tmp_path, behind, behind)).any()


def test_box_crossing_the_image_plane_does_not_smear(tmp_path: Path) -> None:
    # x from -3 to 7, y from 2 to 4: the visible part lies left of u = 800 - 400 * 2 / 7 = 685.7. Dividing the corners
    # behind the camera by their negative depth would draw lines to u = 800 + 400 * 2 / 3.
    box = one_box((2, 3, 0), (10, 2, 2), score=0.9)
    mask = changed(render(tmp_path, box, box))
    assert mask[:, :690].any()
    assert not mask[:, 690:].any()


def test_clipped_edges_agree_with_dense_sampling() -> None:
    rng = np.random.default_rng(0)
    ends = rng.uniform((-30, -30, -8), (30, 30, 8), (300, 2, 3))
    projection = forward_camera()[:3, :3]
    pieces, rows = clip_edges(ends @ projection.T, WIDTH, HEIGHT)
    assert 20 < len(rows) < 280
    at = np.linspace(0, 1, 4001)[:, None]
    for row in range(len(ends)):
        points = ((1 - at) * ends[row, 0] + at * ends[row, 1]) @ projection.T
        pixels = points[:, :2] / points[:, 2:]
        seen = (points[:, 2] >= NEAR_M) & ((pixels >= 0) & (pixels <= (WIDTH, HEIGHT))).all(axis=1)
        if not seen.any():
            assert row not in rows or np.ptp(pieces[rows == row], axis=1).max() < 30  # shorter than a sampling step
            continue
        piece = pieces[list(rows).index(row)]
        assert (piece >= -1e-6).all() and (piece <= np.array([WIDTH, HEIGHT]) + 1e-6).all()
        first, last = points[np.flatnonzero(seen)[[0, -1]]]
        step = np.abs(np.diff(pixels[seen], axis=0)).max(initial=1.0) + 1
        assert np.abs(piece - [first[:2] / first[2], last[:2] / last[2]]).max() < 2 * step


def test_clip_polygon_cuts_at_border_and_drops_what_is_behind() -> None:
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * 10.0
    inside = np.c_[(square + 50) * 2, np.full(4, 2.0)]
    assert np.allclose(clip_polygon(inside, 100, 100), square + 50)
    border = clip_polygon(np.c_[square, np.ones(4)], 100, 100)  # around pixel (0, 0): a quarter is left
    assert np.allclose([border.min(axis=0), border.max(axis=0)], [[0, 0], [10, 10]])
    assert len(clip_polygon(np.c_[square, -np.ones(4)], 100, 100)) == 0


def test_cameras_stand_as_a_person_sits() -> None:
    names = ["CAMERA_RIGHT_BACK", "CAMERA_LEFT_BACK", "CAMERA_RIGHT_FRONT", "CAMERA_LEFT_FRONT"]
    views = PictureViews([None] * 4, np.zeros((4, 4, 4)), names)
    assert [names[i] for i in views.order()] == [names[3], names[2], names[1], names[0]]


def test_missing_image_and_odd_names(tmp_path: Path) -> None:
    image = np.zeros((20, 60, 3), np.uint8)
    views = PictureViews([None, image, None], np.tile(forward_camera(), (3, 1, 1)), ["$\\frac{", "<b>_$x$\n", "A%s{0}"])
    draw_cameras(tmp_path / "a" / "b.png", views, one_box((20, 0, 0), (4, 2, 2), score=1.0), PictureBoxes.empty())
    assert Image.open(tmp_path / "a" / "b.png").size == (1600, 539)  # two rows of 796 / 3 and a gap of 8
