"""Scores over what they cost."""

from pathlib import Path

from PIL import Image

from src.pictures.canvas import Canvas
from src.pictures.trade_off import (
    LABEL_PLACES,
    TradeOff,
    draw_trade_off,
    efficient,
    paint_points,
    spread_labels,
)


def point(label: str, cost: float, score: float) -> TradeOff:
    return TradeOff(label, cost, score, score - 1, score + 2)


POINTS = [
    point("slow", 90.0, 30.0),
    point("beaten", 95.0, 20.0),
    point("quick $", 10.0, 12.0),
    point("same", 10.0, 9.0),
]


def test_what_another_one_beats_at_no_higher_cost_is_not_efficient() -> None:
    assert [p.label for p in efficient(POINTS)] == ["quick $", "slow"]
    assert efficient([]) == []


def test_every_point_is_drawn_with_its_interval_and_name() -> None:
    axes = Canvas(400, 300).axes(30, 30, 340, 240)
    paint_points(axes, POINTS)
    line, *marks = axes.lines
    assert line.get_xydata().tolist() == [[10.0, 12.0], [90.0, 30.0]]
    assert [(mark.get_xdata()[0], mark.get_ydata()[0]) for mark in marks] == [(p.cost, p.score) for p in POINTS]
    assert [bar.get_segments()[0].tolist() for bar in axes.collections][0] == [[90.0, 29.0], [90.0, 32.0]]
    assert [text.get_text() for text in axes.texts] == [p.label for p in POINTS]


def test_ten_points_differ_in_colour_and_in_shape() -> None:
    axes = Canvas(400, 300).axes(30, 30, 340, 240)
    paint_points(axes, [point(str(number), number, number) for number in range(10)])
    _, *marks = axes.lines
    assert len({mark.get_color() for mark in marks}) == len({mark.get_marker() for mark in marks}) == 10


def test_no_label_stands_below_the_axis() -> None:
    axes = Canvas(800, 300).axes(30, 30, 740, 240)
    paint_points(axes, [point("PETR", 60.0, 0.0), point("Far3D", 66.0, 0.2), point("SpaRC", 150.0, 17.0)])
    axes.set(xlim=(0, 200), ylim=(0, 20))
    spread_labels(axes)
    assert all(text.get_window_extent().y0 >= axes.bbox.y0 for text in axes.texts)


def test_labels_of_close_points_stand_apart() -> None:
    axes = Canvas(800, 300).axes(30, 30, 740, 240)
    paint_points(axes, [point("Horizon3D", 283.0, 29.9), point("BEVFusion", 287.0, 31.4), point("far", 100.0, 5.0)])
    axes.set(xlim=(0, 400), ylim=(0, 40))
    spread_labels(axes)
    boxes = [text.get_window_extent(axes.figure.canvas.get_renderer()) for text in axes.texts]
    assert not boxes[0].overlaps(boxes[1])
    assert axes.texts[2].xyann == LABEL_PLACES[0]


def test_a_picture_is_written(tmp_path: Path) -> None:
    draw_trade_off(tmp_path / "in" / "1.png", POINTS, "t $", "ms $", "mAP, %")
    assert Image.open(tmp_path / "in" / "1.png").width == 1600
