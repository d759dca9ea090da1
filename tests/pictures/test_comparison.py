"""Bars of several experiments side by side."""

from __future__ import annotations

from pathlib import Path

from matplotlib.colors import to_hex
from PIL import Image

from src.pictures.canvas import Canvas
from src.pictures.comparison import HEIGHT_PX, BarPanel, draw_comparison, paint_groups


def test_bars_stand_side_by_side_with_their_intervals() -> None:
    axes = Canvas(400, 300).axes(30, 30, 340, 240)
    paint_groups(
        axes,
        BarPanel(
            "t", ["near", "far"], {"a": [(40.0, 32.0, 45.0), (20.0, 20.0, 20.0)], "b": [(50.0, 49.0, 51.0), None]}
        ),
        {"a": "#112233", "b": "#445566"},
    )
    bars = sorted((patch.get_x(), patch.get_height()) for patch in axes.patches)
    assert [height for _, height in bars] == [40.0, 50.0, 20.0]
    colours = [to_hex(patch.get_facecolor()) for patch in sorted(axes.patches, key=lambda p: p.get_x())]
    assert colours == ["#112233", "#445566", "#112233"]
    ends = [patch.get_x() + patch.get_width() for patch in sorted(axes.patches, key=lambda p: p.get_x())]
    assert ends[0] < bars[1][0] and ends[1] < 0.5 < bars[2][0], "bars of a group do not overlap, nor groups"
    assert [text.get_text() for text in axes.texts] == ["40.0", "20.0", "50.0", "-"]
    whiskers = [sorted(segment[:, 1]) for lines in axes.collections for segment in lines.get_segments()]
    assert whiskers == [[32.0, 45.0], [49.0, 51.0]], "none without an interval"
    assert axes.get_ylim()[1] > 51


def test_pictures_are_written(tmp_path: Path) -> None:
    many = {f"experiment $ {i}": [(float(i), i - 0.5, i + 0.5)] for i in range(6)}
    draw_comparison(tmp_path / "out" / "a.png", [BarPanel("x", ["all"], many), BarPanel("y", ["all"], many)], "t $1")
    draw_comparison(tmp_path / "b.png", [])
    assert Image.open(tmp_path / "out" / "a.png").size == (1600, 50 + 2 * 24 + 2 * HEIGHT_PX)
    assert Image.open(tmp_path / "b.png").size == (1600, 50 + HEIGHT_PX)
    draw_comparison(
        tmp_path / "one.png", [BarPanel("AP", ["car", "bus"], {"run": [(50.0, 50.0, 50.0), (0.0, 0.0, 0.0)]})]
    )
    assert Image.open(tmp_path / "one.png").size == (1600, 50 + HEIGHT_PX)  # one experiment needs no key
