"""Effects and their intervals, one below the other."""

from pathlib import Path

from matplotlib.colors import to_hex
from PIL import Image

from src.pictures.canvas import Canvas
from src.pictures.forest import COLOURS, HEAD_PX, ROW_PX, ForestGroup, ForestRow, draw_forest, paint_row, reach


def row(mean: float | None, low: float | None = None, high: float | None = None, **more: object) -> ForestRow:
    return ForestRow("a over b", "mAP", "shows", "+1.0", mean, low, high, **more)


def test_an_effect_its_interval_and_the_one_expected() -> None:
    axes = Canvas(400, 300).axes(30, 30, 340, 240)
    axes.set_xlim(-2, 4)
    paint_row(axes, 5.0, row(1.0, 0.5, 9.0, expected=3.0))
    (line,) = axes.collections
    assert [tuple(point) for point in line.get_segments()[0]] == [(0.5, 5.0), (4.0, 5.0)], "cut at the axis' end"
    marks = {mark.get_marker(): mark.get_xdata()[0] for mark in axes.lines}
    assert marks == {">": 4.0, "D": 3.0, "o": 1.0}
    assert to_hex(axes.lines[-1].get_color()).upper() == COLOURS["shows"]
    paint_row(axes, 6.0, row(None, expected=1.0))
    assert [mark.get_marker() for mark in axes.lines[3:]] == ["D"], "not run: what is expected alone"


def test_the_axis_shows_zero_every_effect_and_not_every_interval() -> None:
    low, high = reach([ForestGroup("g", "shows", [row(2.0, 1.0, 2.5, expected=4.0), row(1.0, -90.0, 90.0)])])
    assert -2.5 < low < -2.0 and 6.0 < high < 6.5  # half of the span from 0 to 4 beside it
    low, high = reach([ForestGroup("g", "shows", [row(2.0, 1.5, 2.5)])])
    assert -0.2 < low < 0 and 2.5 < high < 2.7
    assert reach([]) == (-0.04, 0.04)


def test_a_picture_is_as_high_as_its_rows(tmp_path: Path) -> None:
    groups = [ForestGroup("one $", "not run", [row(None)]), ForestGroup("two", "undecided", [row(1.0), row(2.0)])]
    draw_forest(tmp_path / "in" / "1.png", groups[:1], "t $", "x $")
    draw_forest(tmp_path / "2.png", groups, "t", "x")
    (width, one), (_, two) = (Image.open(tmp_path / name).size for name in ("in/1.png", "2.png"))
    assert width == 1600 and two - one == HEAD_PX + 2 * ROW_PX
