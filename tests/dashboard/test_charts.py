"""Figures: what stands where, and that nothing overlaps, leaves the figure or becomes markup."""

import math
import re
import xml.etree.ElementTree as ET

import pytest

from src.dashboard.charts import (
    GLYPH,
    WIDTH,
    Bars,
    ChartPoint,
    Series,
    category_chart,
    line_chart,
    nice_ticks,
    tick_text,
)


def points_of(*points):
    return [ChartPoint(*point) for point in points]


def parts(figure, kind, of_class=None):
    """Elements of the figure's SVG."""
    return [e for e in ET.fromstring(str(figure)).iter(kind) if of_class in (None, *e.get("class", "").split())]


def places(figure, style=0):
    """Where the markers of one series stand, without the legend's."""
    texts = [mark.get("transform") for mark in parts(figure, "path", f"s{style}") if "mark" in mark.get("class")]
    found = [tuple(map(float, re.fullmatch(r"translate\((\S+) (\S+)\)", text).groups())) for text in texts]
    return [place for place in found if place != (8.0, -4.0)]


def x_texts(figure):
    """Numbers below the horizontal axis with the room they take: (left, right, text)."""
    texts = [e for e in parts(figure, "text", "middle") if e.get("transform") is None and "muted" not in e.get("class")]
    return [(float(e.get("x")) - len(e.text) * GLYPH / 2, float(e.get("x")) + len(e.text) * GLYPH / 2, e.text)
            for e in texts]  # fmt: skip


@pytest.mark.parametrize(
    "low, high, expected",
    [(38, 44, [38, 40, 42, 44]), (0, 1, [0, 0.2, 0.4, 0.6, 0.8, 1.0]), (-1.2, 1.1, [-1, -0.5, 0, 0.5, 1]),
     (0.011, 0.029, [0.015, 0.02, 0.025]), (0, 97, [0, 20, 40, 60, 80]), (5, 5, [5])],
)  # fmt: skip
def test_ticks_are_round_and_inside(low, high, expected):
    assert nice_ticks(low, high) == pytest.approx(expected)


def test_tick_texts_are_short():
    assert [tick_text(v) for v in (0.5, 20.0, 2000.0, 12000.0, 1500000.0, -3.0)] == [
        "0.5", "20", "2000", "12k", "1.5M", "\N{MINUS SIGN}3",
    ]  # fmt: skip


def test_points_stand_in_proportion_and_intervals_have_their_length():
    series = Series(label="here", points=points_of((0, 10, (2.0, 12.0)), (1, 20), (3, 40)))
    figure = line_chart("t", [series], "x", "y")
    (x0, y0), (x1, y1), (x3, y3) = places(figure)
    assert (x3 - x0) / (x1 - x0) == pytest.approx(3, rel=0.01)
    assert (y0 - y3) / (y0 - y1) == pytest.approx(3, rel=0.01)  # upwards is more
    (whisker,) = parts(figure, "path", "whisker")
    low, high = map(float, re.match(r"M\S+ (\S+)V(\S+?)M", whisker.get("d")).groups())
    assert (low - high) / (y0 - y1) == pytest.approx(1.0, rel=0.02)  # ten units, as from 10 to 20
    assert low > y0 > high and (low - y0) / (y0 - high) == pytest.approx(4.0, rel=0.05)


def test_two_figures_of_one_span_have_one_measure():
    steps = []
    for low, high in ((10, 12), (40, 48)):
        series = Series(label="", points=points_of((0, low), (1, high)))
        (_, y0), (_, y1) = places(line_chart("t", [series], "x", "y", y_span=8))
        steps.append((y0 - y1) / (high - low))
    assert steps[0] == pytest.approx(steps[1], rel=0.02)


def test_what_is_no_number_is_left_out():
    series = Series(label="", points=points_of((0, math.nan), (1, 5, None, "b"), (2, math.inf), (3, 6, None, "d")))
    figure = line_chart("t", [series], "x", "y")
    assert [mark.find("title").text for mark in parts(figure, "path", "mark")] == ["b", "d"]
    assert "nan" not in str(figure) and "inf" not in str(figure)
    assert "No values yet" in line_chart("t", [Series(label="", points=points_of((1, math.nan)))], "x", "y")
    assert "No values yet" in line_chart("t", [], "x", "y")


def test_a_logarithmic_axis_leaves_out_what_it_cannot_show():
    series = Series(label="", points=points_of((0.0, 1), (1e-5, 1), (1e-4, 2), (1e-3, 3)), joined=False)
    figure = line_chart("t", [series], "rate", "y", log_x=True)
    (a, _), (b, _), (c, _) = places(figure)
    assert b - a == pytest.approx(c - b, abs=0.2)
    assert [text for *_, text in x_texts(figure)] == ["1e-05", "0.0001", "0.001"]
    assert not parts(figure, "path", "line")
    short = line_chart("t", [Series(label="", points=points_of((2.1e-4, 1), (2.9e-4, 2)))], "rate", "y", log_x=True)
    assert len(x_texts(short)) >= 2


@pytest.mark.parametrize("points", [[(1, 5)], [(1, 5), (2, 5)], [(1, 0), (1, 0)], [(-3, -7), (1e6, 1e9)]])
def test_nothing_leaves_the_figure(points):
    figure = line_chart(
        "t", [Series(label=f"series {n}", points=points_of(*points), style=n) for n in range(9)], "x", "y"
    )
    svg = next(ET.fromstring(str(figure)).iter("svg"))
    *_, height = map(float, svg.get("viewBox").split())
    for x, y in places(figure):
        assert 0 <= x <= WIDTH and 0 <= y <= height
    for entry in svg.iter("g"):  # the legend
        if entry.get("transform"):
            x, y = map(float, re.match(r"translate\((\S+) (\S+)\)", entry.get("transform")).groups())
            assert 0 < y <= height and x + 20 + len(entry.find("text").text) * GLYPH <= WIDTH + 10


def test_texts_on_the_axis_do_not_touch():
    crowded = [(float(x), f"row {x} with a name") for x in (0, 0.1, 0.2, 1, 5, 9.9, 10)]
    figure = line_chart("t", [Series(label="", points=points_of((0, 1), (10, 2)))], "x", "y", x_ticks=crowded)
    texts = sorted(x_texts(figure))
    assert len(texts) >= 2
    assert all(right < left for (_, right, _), (left, _, _) in zip(texts, texts[1:], strict=False))
    assert texts[-1][1] <= WIDTH


def test_an_axis_shows_all_its_marks():
    figure = line_chart(
        "t", [Series(label="", points=points_of((1, 1), (2, 2)))], "x", "y", x_ticks=[(x, f"{x}") for x in (1, 2, 9)]
    )
    assert [text for *_, text in x_texts(figure)] == ["1", "2", "9"]
    (x1, _), (x2, _) = places(figure)
    ticks = [float(line.get("x1")) for line in parts(figure, "line", "axis")][1:]
    assert ticks[:2] == pytest.approx([x1, x2], abs=0.2) and x2 < ticks[2] < WIDTH


def test_series_differ_without_colour():
    figure = line_chart(
        "t", [Series(label=str(n), points=points_of((0, n), (1, n)), style=n) for n in range(10)], "x", "y"
    )
    lines = [path for path in parts(figure, "path", "line")]
    marks = {mark.get("d") for mark in parts(figure, "path", "mark")}
    assert len(marks) == 6
    dashes = {line.get("stroke-dasharray") for line in lines}
    assert {None, "6 3"} == dashes  # from the ninth on, colours come again


def test_figures_have_names_and_escape_them():
    evil = "<script>alert('x')</script>&"
    lines = [
        Series(label=evil, points=[ChartPoint(0, 1, None, evil)]),
        Series(label="b", points=points_of((1, 1)), style=1),
    ]
    bars = [Bars(label=evil, values=[(1.0, 1.0, 1.0), (2.0, 2.0, 2.0)])]
    for figure in (line_chart(evil, lines, evil, evil), category_chart(evil, [evil, "b"], bars, evil)):
        assert "<script" not in figure
        svg = next(ET.fromstring(str(figure)).iter("svg"))
        assert svg.get("role") == "img" and svg.find("title").text == evil and svg.find("desc").text


def test_bars_have_their_lengths_and_numbers():
    bars = [Bars(label="a", values=[(10.0, 8.0, 11.0), None, (40.0, 40.0, 40.0)])]
    figure = category_chart("t", ["x", "y", "z"], bars, "AP, %")
    widths = [float(bar.get("width")) for bar in parts(figure, "rect", "bar")]
    assert widths[2] / widths[0] == pytest.approx(4, rel=0.01) and widths[1] == 0
    assert [text.text for text in parts(figure, "text", "number")] == ["10.0", "\N{EN DASH}", "40.0"]
    assert len(parts(figure, "path", "whisker")) == 1
    assert max(float(text.get("x")) + len(text.text) * GLYPH for text in parts(figure, "text", "number")) <= WIDTH


def test_dots_are_one_for_each_value():
    rows = [Bars(label=str(n), values=[(1.0 * n, n, n), None, (3.0, 3.0, 3.0)], style=n) for n in range(3)]
    figure = category_chart("t", ["x", "y", "z"], rows, "AP, %", dots=True)
    assert [len(places(figure, style)) for style in range(3)] == [2, 2, 2]
