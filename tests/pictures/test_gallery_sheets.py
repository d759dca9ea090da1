"""The sheets of a gallery: what is looked at, where it comes from, what they say of each run."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

from src.pictures import gallery
from src.pictures.bev import BevScene
from src.pictures.cameras import PictureViews
from src.pictures.canvas import SHEET_PX, Canvas
from src.pictures.contents import CLASS_COLOURS, PictureBoxes, PictureGrid
from src.pictures.gallery import GalleryFrame, draw_boxes, draw_whole_frames
from tests.pictures.test_cameras import HEIGHT, WIDTH, forward_camera, one_box

GRID = PictureGrid(-153.6, -153.6, 0.8, 384, 384)
FOUND = one_box((30, 0, 0), (4, 2, 2), score=0.9)


def frame(*predictions: PictureBoxes, box: PictureBoxes | None = None, views=None) -> GalleryFrame:
    truth = one_box((30, 0, 0), (4, 2, 2))
    return GalleryFrame("A frame", [BevScene(GRID, one, truth) for one in predictions], views, box)


@pytest.fixture
def texts(monkeypatch) -> list[str]:
    said, text = [], Canvas.text
    monkeypatch.setattr(Canvas, "text", lambda self, *rest, **more: (said.append(rest[2]), text(self, *rest, **more)))
    return said


def test_each_run_has_a_panel_and_its_counts(tmp_path: Path, texts: list[str]) -> None:
    frames = [frame(PictureBoxes.empty(), FOUND)] * 3
    draw_whole_frames(tmp_path / "a.png", "A title", frames, ["one", "two"], 0.25)
    said = [text for text in texts if text in ("one", "two") or "found" in text]
    assert said == ["one", "0 of 1 found, 0 false", "two", "1 of 1 found, 0 false"] * 3
    with Image.open(tmp_path / "a.png") as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    assert pixels.shape[1] == SHEET_PX
    car = (np.abs(pixels - 255 * np.array(to_rgb(CLASS_COLOURS["car"]))) < 12).all(axis=2)
    car[: gallery.HEADER_PX] = False
    columns = np.flatnonzero(car.any(axis=0))
    # The second of two panels of each cell alone.
    assert set(columns // 400) == {1, 3}


def test_a_long_name_is_no_wider_than_its_panel(tmp_path: Path, monkeypatch) -> None:
    widths, text = [], Canvas.text

    def measured(self, *rest, **more):
        text(self, *rest, **more)
        if rest[2] in names:
            widths.append(self.figure.texts[-1].get_window_extent().width)

    monkeypatch.setattr(Canvas, "text", measured)
    names = [f"horizon3d-phase1_further-mini-0123456{digit}" for digit in range(3)]
    frames = [frame(FOUND, FOUND, FOUND, box=FOUND)] * 2
    draw_whole_frames(tmp_path / "a.png", "", frames, names, 0.25)
    draw_boxes(tmp_path / "b.png", "", frames, names, 0.25)
    # Three panels to a cell of 784 px, then three beside an image; gaps of 12 px.
    assert len(widths) == 12 and max(widths[:6]) <= 253 and max(widths[6:]) <= 187


def views(*colours: int) -> PictureViews:
    """Cameras that look ahead, back, and ahead with twice the focal length, as grey fields."""
    ahead = forward_camera()
    back, near = ahead @ np.diag([-1.0, -1, 1, 1]), ahead.copy()
    near[:2, 1:3] *= 2
    images = [np.full((HEIGHT, WIDTH, 3), colour, np.uint8) for colour in colours]
    names = ["CAMERA_LEFT_FRONT", "CAMERA_LEFT_BACK", "CAMERA_RIGHT_FRONT"]
    return PictureViews(images, np.stack([ahead, back, near])[: len(colours)], names[: len(colours)])


@pytest.mark.parametrize(
    ("place", "colours", "seen"), [((30, 0), (50, 90), 50), ((-30, 0), (50, 90), 90), ((30, 0), (50, 90, 130), 130)]
)
def test_a_box_is_shown_where_it_is_largest(tmp_path: Path, place, colours, seen) -> None:
    looked_at = one_box((*place, 0), (4, 2, 2))
    shown = frame(PictureBoxes.empty(), box=looked_at, views=views(*colours))
    draw_boxes(tmp_path / "a.png", "", [shown, shown], ["one"], 0.25)
    with Image.open(tmp_path / "a.png") as picture:
        pixels = np.asarray(picture.convert("RGB"))
    corner = pixels[gallery.HEADER_PX + gallery.TITLE_PX + 60, 30]
    assert abs(int(corner[0]) - seen) < 8


def test_what_no_camera_shows_says_so(tmp_path: Path) -> None:
    for cameras in (None, views(50)):
        shown = frame(PictureBoxes.empty(), box=one_box((-30, 0, 0), (4, 2, 2)), views=cameras)
        draw_boxes(tmp_path / "a.png", "", [shown], ["one"], 0.25)
        with Image.open(tmp_path / "a.png") as picture:
            corner = np.asarray(picture.convert("RGB"))[gallery.HEADER_PX + gallery.TITLE_PX + 60, 30]
        assert tuple(corner) == pytest.approx((228, 231, 234), abs=4)


def test_the_box_that_is_looked_at_is_marked_in_the_image_and_on_the_ground_of_each_run(tmp_path: Path) -> None:
    """Of two boxes the one at 30 m ahead, in the middle of its panels; the other, 10 m to its left, is not."""
    box, other = one_box((30, 0, 0), (4, 2, 2)), one_box((30, 10, 0), (4, 2, 2))
    shown = GalleryFrame("A frame", [BevScene(GRID, PictureBoxes.empty(), other)] * 2, views(50), box)
    draw_boxes(tmp_path / "a.png", "", [shown], ["one", "two"], 0.25)
    with Image.open(tmp_path / "a.png") as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    marked = (np.abs(pixels - 255 * np.array(to_rgb(gallery.MARK_COLOUR))) < 40).all(axis=2)
    marked[: gallery.HEADER_PX] = False
    side = (SHEET_PX - 20 - 24) / 3  # image and two panels of one wide cell, 12 px apart
    for place in range(3):
        left = 10 + place * (side + 12)
        columns = np.flatnonzero(marked[:, round(left) : round(left + side)].any(axis=0))
        assert len(columns) and abs(columns.mean() - side / 2) < 6, place
        assert np.ptp(columns) < side / 2
