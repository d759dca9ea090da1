"""Scores over what they cost."""

from pathlib import Path

from PIL import Image

from src.pictures.canvas import Canvas
from src.pictures.trade_off import TradeOff, draw_trade_off, efficient, paint_points


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


def test_a_picture_is_written(tmp_path: Path) -> None:
    draw_trade_off(tmp_path / "in" / "1.png", POINTS, "t $", "ms $", "mAP, %")
    assert Image.open(tmp_path / "in" / "1.png").width == 1600
