"""The page of figures: its width, its marks, its pictures."""

from PIL import Image

from src.world.real_comparison import FigureTable
from src.world.statistics_page import page_text, table_lines, verdict, write_page

SUPPORT = FigureTable(
    name="support", title="Boxes with a point", unit="percent", sources=["a/b@c"], trust="high", allowed=15,
    allowed_heavy=10,
    world={"car": {"0-25": (50.0, 900), "150+": (4.4, 30)}, "traffic_sign": {"0-25": (1.0, 8)}},
    real={"car": {"0-25": (66.0, 50), "150+": (5.0, 70)}, "traffic_sign": {"0-25": (99.0, 49)}},
)  # fmt: skip


def test_cells_hold_both_figures_with_their_boxes_and_are_bold_where_they_differ_too_much():
    assert table_lines(SUPPORT) == [
        "| | 0-25 | 150+ |",
        "|---|---|---|",
        "| car | **50 (900) / 66 (50)** | 4.4 (30) / 5 (70) |",
        "| traffic sign | 1 (8) / 99 (49) |  |",
    ]
    assert verdict([SUPPORT]) == [
        "- Boxes with a point: 1 of 2 cells within 15 (truck, bus, trailer: 10) points; beyond: car 0-25 m 50 / 66"
    ]
    alone = FigureTable(name="x", title="", unit="", sources=[], trust="", world={"all": {"now": (5.0, 3)}}, real={})
    assert table_lines(alone)[-1] == "| all | 5 (3) |"


def test_the_page_is_written_with_its_pictures(tmp_path):
    path = write_page(tmp_path / "world", [SUPPORT], "2 scenes", "python -m src.world compare=true")
    text = path.read_text()
    assert text == page_text([SUPPORT], "2 scenes", "python -m src.world compare=true")
    assert "![Boxes with a radar point, %](support.png)" in text and "a/b@c" in text
    with Image.open(path.parent / "support.png") as image:
        assert image.width == 1600
