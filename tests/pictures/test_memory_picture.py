"""The memory picture: where things lie with and without velocity, which window is chosen, what ends up in the PNG."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

from src.pictures.canvas import GAP_PX, MARGIN_PX
from src.pictures.contents import PictureBoxes, PictureGaussians, PictureGrid, PictureMemory
from src.pictures.memory_picture import (
    CAPTION_PX,
    CLOSE_PX,
    HEADER_PX,
    TRUTH_COLOUR,
    AgeScale,
    MemoryScene,
    arrow_means,
    close_window,
    draw_memory,
    hits_line,
)

GRID = PictureGrid(-153.6, -153.6, 0.8, 384, 384)
WIDTH_M, HEIGHT_M = 55.0, 103.0


def boxes(rows: list[tuple[float, float, float, float]]) -> PictureBoxes:
    """Cars heading along x, from (x, y, vx, vy)."""
    k, values = len(rows), np.reshape(rows, (-1, 4))
    return PictureBoxes(
        np.c_[values[:, :2], np.zeros(k)], np.tile((5.0, 2.0, 2.0), (k, 1)), np.zeros(k), values[:, 2:], np.zeros(k)
    )


def cells(moved: list[tuple[float, float]], velocity: tuple[float, float], age_s: float) -> PictureMemory:
    n = len(moved)
    return PictureMemory(np.reshape(moved, (n, 2)), np.tile(velocity, (n, 1)), np.full(n, age_s))


def gaussians(xy: list[tuple[float, float]], velocity: tuple[float, float], age_s: float) -> PictureMemory:
    n = len(xy)
    shapes = PictureGaussians(xy, np.ones((n, 2)), np.tile((1.0, 0.0), (n, 1)), np.full(n, 0.9), np.full(n, 3))
    return PictureMemory(xy, np.tile(velocity, (n, 1)), np.full(n, age_s), shapes)


def inside(window: tuple, x: float, y: float) -> bool:
    (left, right), (down, up) = window
    return left <= -y <= right and down <= x <= up


def test_both_places_from_what_the_model_read() -> None:
    xy, velocity, age = np.array([[10.0, -4.0]]), np.array([[20.0, -2.0]]), np.array([1.5])
    used = PictureMemory(xy, velocity, age, compensated=True)
    assert np.allclose(used.moved, [[10, -4]]) and np.allclose(used.stayed, [[-20, -1]])
    unused = PictureMemory(xy, velocity, age, compensated=False)
    assert np.allclose(unused.stayed, [[10, -4]]) and np.allclose(unused.moved, [[40, -7]])


def test_drawn_oldest_first_and_only_what_is_finite() -> None:
    memory = PictureMemory(
        np.array([(1.0, 0), (2, 0), (np.nan, 0), (4, 0)]), np.zeros((4, 2)), np.array([0.5, 2.0, 1.0, np.inf])
    )
    assert memory.drawable().moved[:, 0].tolist() == [2, 1]
    broken = gaussians([(1.0, 0.0), (2.0, 0.0)], (0, 0), 0.5)
    broken.gaussians.scales[0] = np.inf
    assert broken.drawable().moved.tolist() == [[2, 0]]
    assert len(broken.drawable().gaussians) == 1


def test_points_on_turned_boxes() -> None:
    turned = PictureBoxes([(10, 20, 0)], [(4, 2, 2)], [np.pi / 2], [(0, 5)], [0])
    assert turned.cover(np.array([(10, 21.9), (11.9, 20), (10.9, 18.1), (10, 22.1)])).tolist() == [
        True, False, True, False
    ]  # fmt: skip
    assert not PictureBoxes.empty().cover(np.zeros((3, 2))).any()


def test_hits_are_counted_on_both_places() -> None:
    memory = cells([(50, 0), (52, 0), (80, 0)], (20.0, 0.0), 1.0)
    line = hits_line("BEV cells", memory, boxes([(50, 0, 20, 0), (30, 0, -20, 0)]))
    assert line == "BEV cells: 3, on moving boxes 2 without velocity → 2 with"
    assert "0 without velocity → 2 with" in hits_line("BEV cells", memory, boxes([(50, 0, 20, 0)]))


def test_window_holds_the_fastest_and_its_trail() -> None:
    truth = boxes([(-100, 40, 5, 0), (90, -30, 30, 0), (100, -35, 20, 0), (-110, 45, 4, 0), (0, 0, 0, 0)])
    window = close_window(MemoryScene(GRID, truth), WIDTH_M, HEIGHT_M)
    (left, right), (down, up) = window
    assert (right - left, up - down) == pytest.approx((WIDTH_M, HEIGHT_M))
    assert inside(window, 90, -30) and inside(window, 30, -30)  # now, and two seconds ago
    assert inside(window, 100, -35)  # the next fastest fits as well
    assert not inside(window, -100, 40)


def test_window_prefers_what_is_remembered_over_what_is_fastest() -> None:
    truth = boxes([(-100, 40, 12, 0), (90, -30, 30, 0)])
    # A cell of the slower car without compensation: on its trail, one second behind.
    scene = MemoryScene(GRID, truth, cells=cells([(-112, 40)], (0.0, 0.0), 1.0))
    assert inside(close_window(scene, WIDTH_M, HEIGHT_M), -100, 40)
    assert not inside(close_window(scene, WIDTH_M, HEIGHT_M), 90, -30)
    far = MemoryScene(GRID, truth, cells=cells([(0, 140)], (0.0, 0.0), 1.0))  # of neither
    assert inside(close_window(far, WIDTH_M, HEIGHT_M), 90, -30)


@pytest.mark.parametrize("velocity", [(0.0, 40.0), (0.0, -60.0), (55.0, 0.0)])
def test_a_trail_longer_than_the_window_keeps_the_object_in(velocity: tuple[float, float]) -> None:
    window = close_window(MemoryScene(GRID, boxes([(20, 10, *velocity)])), WIDTH_M, HEIGHT_M)
    assert inside(window, 20, 10)


def test_window_without_anything_moving_shows_the_ego_and_stays_on_the_grid() -> None:
    for truth in (PictureBoxes.empty(), boxes([(90, 90, 0, 0), (-90, 90, np.nan, np.nan)])):
        assert inside(close_window(MemoryScene(GRID, truth), WIDTH_M, HEIGHT_M), 0, 0)
    (left, right), (down, up) = close_window(MemoryScene(GRID, boxes([(150, -150, 30, 0)])), WIDTH_M, HEIGHT_M)
    assert max(right, up) <= 153.6 + 1e-6
    small = PictureGrid(-19.2, -25.6, 0.8, 64, 48)
    (left, right), (down, up) = close_window(MemoryScene(small, boxes([(10, 5, 9, 0)])), WIDTH_M, HEIGHT_M)
    assert ((left + right) / 2, (down + up) / 2) == pytest.approx((0, 0))  # larger than the grid: centred on it


def test_ages_have_their_own_colours() -> None:
    scene = MemoryScene(
        GRID, gaussians=gaussians([(0.0, 0.0)], (0, 0), 0.5), cells=cells([(1, 1)] * 2, (0.0, 0.0), 1.02)
    )
    scale = AgeScale.of(scene)
    assert scale.ages_s == (0.5, 1.0)
    young, old = scale.colours(np.array([0.5, 1.0]))
    assert np.abs(young - old).sum() > 0.5
    assert [key.get_label() for key in scale.keys()] == ["0.5 s", "1.0 s"]
    many = AgeScale(tuple(np.arange(1, 30) / 10))
    assert len(many.keys()) == 8
    assert AgeScale.of(MemoryScene(GRID)).keys() == []


def test_arrows_are_means_of_the_freshest_in_a_block() -> None:
    memory = PictureMemory(
        np.array([(0.5, 0.5), (1.5, 0.5), (1.0, 1.0), (10.0, 10.0), (20.0, 20.0)]),
        np.array([(10.0, 0), (20, 0), (50, 0), (0, 8), (0.2, 0)]),
        np.array([0.5, 0.5, 1.0, 2.0, 0.5]),
    )
    starts, velocities = arrow_means(memory.moved, memory)
    rows = np.argsort(starts[:, 0])
    assert np.allclose(starts[rows], [(1.0, 0.5), (10, 10)])  # the last one stands still
    assert np.allclose(velocities[rows], [(15, 0), (0, 8)])
    assert [len(part) for part in arrow_means(np.zeros((0, 2)), cells([], (0.0, 0.0), 1.0))] == [0, 0]


def render(path: Path, scene: MemoryScene) -> np.ndarray:
    draw_memory(path, scene, "Sample $\\frac{ <b>")
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


@pytest.mark.slow
def test_each_memory_is_called_by_what_it_holds() -> None:
    one = cells([(1, 1)], (0.0, 0.0), 1.0)
    scene = MemoryScene(GRID, boxes([]), cells=one, queries=cells([(1, 1), (2, 2)], (0.0, 0.0), 1.0)).drawable()
    assert [(name, len(memory)) for name, memory in scene.paths()] == [("BEV cells", 1), ("Queries", 2)]


def test_cells_lie_behind_the_box_without_velocity_and_on_it_with(tmp_path: Path) -> None:
    truth = PictureBoxes([(0, 60, 0)], [(8, 6, 2)], [0.0], [(20, 0)], [0])
    patch = [(x, y) for x in np.arange(-2, 2.5, 0.8) for y in np.arange(58, 62.5, 0.8)]
    memory = cells(patch, (20.0, 0.0), 2.0)
    scene = MemoryScene(GRID, truth, cells=memory)
    picture, empty = render(tmp_path / "a.png", scene), render(tmp_path / "b.png", MemoryScene(GRID, truth))
    assert empty.shape[0] < HEADER_PX + 2 * MARGIN_PX  # no path, no panel
    width = (1600 - 2 * MARGIN_PX - GAP_PX) / 2
    (left, right), (down, up) = close_window(scene, width / 7, CLOSE_PX / 7)

    def colour_at(x: float, y: float, column: int) -> np.ndarray:
        row = HEADER_PX + CAPTION_PX + (up - x) * 7
        col = MARGIN_PX + column * (width + GAP_PX) + (-y - left) * 7
        return picture[round(row), round(col)]

    age = 255 * AgeScale.of(scene).colours(np.array([2.0]))[0, :3]
    for column, x in ((0, -41.0), (1, -1.0)):
        assert np.abs(colour_at(x, 58.1, column) - age).sum() < 40, column
        assert np.abs(colour_at(x, 58.1, 1 - column) - age).sum() > 100, column
    green = np.abs(picture - 255 * np.array(to_rgb(TRUTH_COLOUR))).sum(axis=2) < 30
    assert green[HEADER_PX:, : 1600 // 2].any() and green[HEADER_PX:, 1600 // 2 :].any()


@pytest.mark.slow
def test_every_kind_of_gap_still_gives_a_picture(tmp_path: Path) -> None:
    truth = boxes([(30, 5, 10, 0), (10, -5, 0, 0)])
    history = gaussians([(30.0, 5.0), (140.0, -20.0)], (12.0, 0.0), 0.5)
    no_shapes = PictureGaussians(*[np.zeros((0, 2))] * 3, *[np.zeros(0)] * 2)
    empty_history = PictureMemory(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), no_shapes)
    scenes = {
        "no truth, one path": MemoryScene(GRID, gaussians=history),
        "nothing remembered": MemoryScene(GRID, truth, empty_history, cells([], (0.0, 0.0), 1.0)),
        "broken and out of sight": MemoryScene(
            GRID,
            boxes([(np.inf, 0, 1, 1), (0, 0, np.nan, 1)]),
            history,
            PictureMemory(np.array([(np.nan, 0), (500, 500)]), np.ones((2, 2)), np.ones(2)),
        ),
    }
    for name, scene in scenes.items():
        picture = render(tmp_path / f"{name}.png", scene)
        assert picture.shape[1] == 1600 and picture.shape[0] > CLOSE_PX, name


@pytest.mark.slow
def test_a_full_memory_stays_small(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    n = 8 * 4096  # all that the paper's settings can remember, along a road
    xy, velocity = rng.normal(0, (60, 12), (n, 2)), rng.normal(0, (8, 1), (n, 2))
    memory = PictureMemory(xy, velocity, np.repeat(np.arange(8) / 2 + 0.5, 4096))
    render(tmp_path / "a.png", MemoryScene(GRID, boxes([(30, 5, 10, 0)] * 50), cells=memory))
    assert (tmp_path / "a.png").stat().st_size < 400_000
