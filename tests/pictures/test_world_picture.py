"""Slices, forecasts and scores of a world model: what is drawn lies where it is, in the size of all pictures."""

import numpy as np
from PIL import Image

from src.pictures.bev import upright
from src.pictures.canvas import Canvas
from src.pictures.world_picture import (
    FORECAST_COLOUR,
    WINDOW,
    ForecastMoment,
    OccupancySlice,
    _paint_ends,
    _paint_slice,
    draw_forecast,
    draw_horizons,
    draw_slices,
)

SIZE = 1600


def slice_of(occupied, time_s=0.0, speeds=None):
    """A lattice of 1 m from -10 to 10 m, with one occupied cell."""
    x, y = (values.ravel() for values in np.meshgrid(np.arange(-9.5, 10), np.arange(-9.5, 10), indexing="ij"))
    points = np.stack([x, y], 1)
    there = (points == occupied).all(1)
    return OccupancySlice(time_s, points, 1.0, there.astype(float), None if speeds is None else speeds * there, there)


def panel():
    axes = Canvas(400, 400).axes(0, 0, 400, 400)
    axes.set_xlim(*WINDOW[0])
    axes.set_ylim(*WINDOW[1])
    return axes


def test_a_cell_is_drawn_where_it_is():
    axes = panel()
    _paint_slice(axes, slice_of((4.5, 2.5), speeds=20.0))
    (image,) = axes.images
    (up,), (right,) = np.nonzero(image.get_array()[..., 3] > 0)
    left, _, bottom, _ = image.get_extent()
    assert (left + right + 0.5, bottom + up + 0.5) == tuple(upright(np.array([4.5, 2.5])))
    red, _, blue = image.get_array()[up, right, :3]
    assert red > blue, "what moves away is orange"
    assert axes.get_xlim() == WINDOW[0] and axes.get_ylim() == WINDOW[1]


def moment(time_s):
    directions = np.array([[1.0, 0, 0], [0, 1.0, 0], [0.6, -0.8, 0]])
    return ForecastMoment(time_s, np.full((3, 3), 1.0), directions, *(np.array([10.0, 5, 5]) * k for k in (1, 2, 3)))


def test_rays_end_where_they_end():
    axes, one = panel(), moment(1.0)
    _paint_ends(axes, one, one.forecast_m, FORECAST_COLOUR, 2.0)
    (line,) = axes.lines
    np.testing.assert_allclose(np.stack(line.get_data(), 1), [[-1, 21], [-11, 1], [7, 7]])


def test_pictures_have_a_panel_a_time(tmp_path):
    draw_slices(tmp_path / "slices.png", [slice_of((0.5, 0.5), time) for time in (0.0, 1.0)], "t", 1.0)
    draw_forecast(tmp_path / "one.png", [moment(1.0)], "t")
    draw_forecast(tmp_path / "two.png", [moment(1.0), moment(3.0)], "t")
    sizes = [Image.open(tmp_path / f"{name}.png").size for name in ("slices", "one", "two")]
    assert {width for width, _ in sizes} == {SIZE} and sizes[2][1] > 1.8 * sizes[1][1]


def test_scores_of_occupancy_alone_take_one_panel(tmp_path):
    occupancy = {"iou": 0.5, "iou@0.0s": 0.5, "iou@3.0s": 0.4, "slice_iou@0.0s": 0.1, "slice_iou@3.0s": None}
    draw_horizons(tmp_path / "a.png", occupancy, "t")
    forecast = occupancy | {"cd@3.0s": 1.0, "static_cd@3.0s": 2.0, "l1_0-50m_3s": 1.0, "cd_moving@3.0s": None}
    draw_horizons(tmp_path / "b.png", forecast, "t")
    (_, one), (_, four) = (Image.open(tmp_path / f"{name}.png").size for name in "ab")
    assert four > 3 * one
