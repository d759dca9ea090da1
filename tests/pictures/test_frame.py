"""Whole sheets: BEV geometry in pixels, empty inputs, a real frame."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

from src.pictures.bev import BevScene, radial_speeds
from src.pictures.cameras import PictureViews
from src.pictures.canvas import CAPTION_PX, GAP_PX, MARGIN_PX
from src.pictures.contents import (
    CLASS_COLOURS,
    SOURCE_COLOURS,
    PictureBoxes,
    PictureGaussians,
    PictureGrid,
    match_boxes,
)
from src.pictures.frame import HEADER_PX, counts_line, draw_frame

REAL = Path(__file__).parents[3] / "shared" / "real" / "horizon3d_page" / "ocsf_demo.json"
GRID = PictureGrid(-153.6, -153.6, 0.8, 384, 384)
SIDE_PX = (1600 - 2 * MARGIN_PX - GAP_PX) / 2


def pixel_of(x: float, y: float, column: int = 0) -> tuple[float, float]:
    """(row, column) in the sheet of an ego position in one of the two upper panels: forward is up, left is left."""
    scale = SIDE_PX / 307.2
    left = MARGIN_PX + column * (SIDE_PX + GAP_PX)
    return HEADER_PX + CAPTION_PX + (153.6 - x) * scale, left + (153.6 - y) * scale


def render(path: Path, scene: BevScene) -> np.ndarray:
    draw_frame(path, scene)
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


def drawn(picture: np.ndarray, empty: np.ndarray, column: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the pixels that differ within the left or right upper panel."""
    mask = (np.abs(picture - empty) > 12).any(axis=2)
    mask[: HEADER_PX + CAPTION_PX] = False
    mask[round(HEADER_PX + CAPTION_PX + SIDE_PX) :] = False
    middle = round(MARGIN_PX + SIDE_PX + GAP_PX / 2)
    mask[:, middle:] &= column == 1
    mask[:, :middle] &= column == 0
    return np.nonzero(mask)


def box(x: float, y: float, velocity: tuple[float, float], score: float | None) -> PictureBoxes:
    scores = None if score is None else [score]
    return PictureBoxes([(x, y, 1)], [(12, 3, 3)], [0.0], [velocity], [0], scores)


def test_box_and_arrow_lie_where_they_should(tmp_path: Path) -> None:
    empty = render(tmp_path / "a.png", BevScene(GRID))
    still = render(tmp_path / "b.png", BevScene(GRID, box(80, 90, (np.nan, np.nan), 0.9)))
    rows, cols = drawn(still, empty)
    (top, left), (bottom, right) = pixel_of(86, 91.5), pixel_of(74, 88.5)
    assert (rows.min(), rows.max()) == pytest.approx((top, bottom), abs=4)
    assert (cols.min(), cols.max()) == pytest.approx((left, right), abs=4)
    row, col = map(round, pixel_of(80, 91.5))
    blue = np.array(to_rgb(CLASS_COLOURS["car"])) * 255
    assert np.abs(still[row, col - 2 : col + 3] - blue).sum(axis=1).min() < 80

    moving = render(tmp_path / "c.png", BevScene(GRID, box(80, 90, (0, -60), 0.9)))  # to the right, 30 m in 0.5 s
    rows, cols = drawn(moving, empty)
    assert cols.max() == pytest.approx(pixel_of(80, 60)[1], abs=4)
    assert (rows.min(), rows.max()) == pytest.approx((top, bottom), abs=4)


def test_ground_truth_and_missed_ring(tmp_path: Path) -> None:
    other = box(-100, -100, (0, 0), 0.9)
    without = render(tmp_path / "a.png", BevScene(GRID, other))
    missed = render(tmp_path / "b.png", BevScene(GRID, other, box(80, 90, (0, 0), None)))
    rows, cols = drawn(missed, without)
    centre = pixel_of(80, 90)
    assert ((rows.min() + rows.max()) / 2, (cols.min() + cols.max()) / 2) == pytest.approx(centre, abs=3)
    red = missed[..., 0] - missed[..., 1] - (without[..., 0] - without[..., 1]) > 60
    assert red[round(centre[0]) - 20 : round(centre[0]) + 20, round(centre[1]) - 20 : round(centre[1]) + 20].any()


@pytest.mark.slow
def test_occupancy_cell_and_gaussian_land_on_their_place(tmp_path: Path) -> None:
    none = PictureGaussians(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    empty = render(tmp_path / "a.png", BevScene(GRID, gaussians=none))
    # Cells (row, col) = (y, x): a 10 x 10 block around x = 153.6 - 80 * 0.8, y = -153.6 + 40 * 0.8.
    cells = np.stack(np.meshgrid(np.arange(35, 45), np.arange(299, 309), indexing="ij"), axis=-1).reshape(-1, 2)
    scene = BevScene(GRID, gaussians=none, occupancy=(cells, np.ones(len(cells))))
    rows, cols = drawn(render(tmp_path / "b.png", scene), empty, column=1)
    expected = pixel_of(-153.6 + 304 * 0.8, -153.6 + 40 * 0.8, column=1)
    assert (rows.mean(), cols.mean()) == pytest.approx(expected, abs=1.5)
    assert np.ptp(rows) == pytest.approx(8 * SIDE_PX / 307.2, abs=2)

    gaussian = PictureGaussians([(-60, 100)], [(10, 2)], [(0, 1)], [1.0], [1])
    picture = render(tmp_path / "c.png", BevScene(GRID, gaussians=gaussian))
    rows, cols = drawn(picture, empty, column=1)
    assert (rows.mean(), cols.mean()) == pytest.approx(pixel_of(-60, 100, column=1), abs=1.5)
    assert np.ptp(cols) == pytest.approx(20 * SIDE_PX / 307.2, abs=4)  # long along y
    edge = np.array(to_rgb(SOURCE_COLOURS["camera"])) * 255
    assert np.abs(picture[rows, cols] - edge).sum(axis=1).min() < 60


def test_lidar_points_stand_where_there_is_no_radar(tmp_path: Path) -> None:
    lidar, radar = np.array([[80.0, 90, 1, 12, 0], [np.nan] * 5]), np.zeros((0, 7))
    empty = render(tmp_path / "a.png", BevScene(GRID, lidar_points=np.zeros((0, 5))))
    rows, cols = drawn(render(tmp_path / "b.png", BevScene(GRID, lidar_points=lidar)), empty)
    assert (rows.mean(), cols.mean()) == pytest.approx(pixel_of(80, 90), abs=1.5)
    with_radar = render(tmp_path / "c.png", BevScene(GRID, radar_points=radar))
    both = render(tmp_path / "d.png", BevScene(GRID, radar_points=radar, lidar_points=lidar))
    assert (both == with_radar).all()


def test_radar_speed_has_the_sign_of_its_direction() -> None:
    points = np.zeros((3, 7))
    points[:, :2] = (10, 0), (-10, 0), (0, 10)
    points[:, 4:6] = (3, 0), (3, 0), (0, 0)
    assert radial_speeds(points).tolist() == [3, -3, 0]


def test_empty_and_broken_inputs_still_give_a_picture(tmp_path: Path) -> None:
    draw_frame(tmp_path / "deep" / "a.png", BevScene(GRID), PictureViews([], np.zeros((0, 4, 4)), []))
    gaussians = PictureGaussians([(np.nan, 0), (0, 0)], np.ones((2, 2)), [(0, 0), (1, 0)], [0.5, np.inf], [0, 3])
    radar = np.array([[np.nan] * 7, [10, 0, 0, 0, 0, 0, 0]])
    occupancy = (np.array([[-1, 0], [0, 999], [3, 3]]), np.array([1.0, 1.0, np.nan]))
    broken = box(np.inf, 0, (1, 1), 0.5)
    scene = BevScene(GRID, broken, broken, radar, gaussians, occupancy)
    title = "scene $\\frac{ <b> \n 100% {0} " + "x" * 200
    draw_frame(tmp_path / "b.png", scene, PictureViews([None], np.eye(4)[None], ["CAMERA_$"]), title, 0.3)
    for name in ("deep/a.png", "b.png"):
        with Image.open(tmp_path / name) as picture:
            picture.verify()
            assert picture.size[0] == 1600
    tall = Image.open(tmp_path / "b.png").size[1] - Image.open(tmp_path / "deep/a.png").size[1]
    assert tall > 700  # a camera row and the second row of panels


def test_counts_line() -> None:
    scene = BevScene(GRID, box(0, 0, (0, 0), 0.9), box(1, 0, (0, 0), None))
    line = counts_line(scene, 0.3)
    assert "1 ground truth" in line and "1 matched" in line and "0 missed" in line and "0 false" in line
    assert "no ground truth" in counts_line(BevScene(GRID), 0.3)
    assert counts_line(BevScene(GRID, box(1, 0, (0, 0), None)), 0.0) == "1 true boxes"


@pytest.mark.skipif(not REAL.exists(), reason="the published demo frame is not at hand")
def test_real_frame_is_drawn_quickly(tmp_path: Path) -> None:
    page = json.loads(REAL.read_text())
    frame, cells_per_side = page["frame"], page["bev_out_size"]

    def ours(rows: list, velocities: list, scored: bool) -> PictureBoxes:
        # The page's frame drives towards -x: turned by half a circle; its yaw is -heading - pi/2.
        values = np.array(rows)
        heights = np.full(len(values), 2.0)
        return PictureBoxes(
            np.c_[-values[:, :2], heights / 2], np.c_[values[:, 3], values[:, 2], heights], np.pi / 2 - values[:, 4],
            -np.array(velocities), values[:, 5], np.ones(len(values)) if scored else None,
        )  # fmt: skip

    predictions = ours(frame["pred_boxes"], frame["pred_velocities"], True)
    truth = ours(frame["gt_boxes"], frame["gt_velocities"], False)
    assert match_boxes(predictions, truth)[0].mean() > 0.6
    fast = np.linalg.norm(truth.velocities, axis=1) > 5
    heading = np.stack([np.cos(truth.yaws), np.sin(truth.yaws)], axis=1)
    along = (heading * truth.velocities).sum(axis=1)[fast] / np.linalg.norm(truth.velocities, axis=1)[fast]
    assert np.median(along) > 0.99  # boxes point where they drive

    g = frame["gaussians"]
    gaussians = PictureGaussians(
        -np.array(g["means"]), g["scales"], -np.array(g["rotations"]), g["opacities"], g["sources"]
    )
    occupancy = np.array(frame["bev_occupancy"])
    cells = cells_per_side - 1 - occupancy[:, :2].astype(int)
    grid = PictureGrid(-153.6, -153.6, 307.2 / cells_per_side, cells_per_side, cells_per_side)
    scene = BevScene(grid, predictions, truth, None, gaussians, (cells, occupancy[:, 2]))
    begin = time.perf_counter()
    draw_frame(tmp_path / "real.png", scene, title="project page, OCSF demo")
    assert time.perf_counter() - begin < 10
    assert Image.open(tmp_path / "real.png").size[0] == 1600
