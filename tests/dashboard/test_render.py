"""Numbers and words of the pages: tables as in the files, differences, configurations."""

import dataclasses
import re

import pytest
from markupsafe import escape

from src.dashboard.board import BoardReader
from src.dashboard.figures import headline
from src.dashboard.render import (
    Renderer,
    config_difference,
    flat_config,
    metric_rows,
    signed,
)
from tests.dashboard.experiments import EVIL


@pytest.fixture
def board(shared_world):
    return BoardReader(shared_world.reports, shared_world.outputs).read()[0]


@pytest.fixture
def renderer():
    return Renderer(lambda kind, name="": f"/{kind}/{name}", lambda picture: f"/pictures/{picture.name}", live=True)


def test_tables_hold_the_numbers_of_the_files(board, renderer):
    sweep = board.sweep("epsilon_mini")
    (table,) = sweep.tables
    assert [table.parts(0), table.parts(1)] == [["paper", "here", "to baseline"], ["here", "to baseline"]]
    # Rows 30 and 32, 35 alone (the other seed failed), 40 and 42: means 31, 35, 41; deviation 1.4.
    rows = [list(table.shown(row)) for row in table.rows]
    assert [cells[1].text for cells in rows] == ["31.0 ± 1.4", "35.0", "41.0 ± 1.4"]
    assert [cells[1].best for cells in rows] == [False, False, True]
    assert [cells[2].text for cells in rows][::2] == ["-10.0 ± 0.0 (paper -4.0)", "baseline"]
    assert [cells[2].verdict for cells in rows] == ["worse", "worse", ""]
    assert rows[0][4].verdict == "worse"  # a larger error
    markdown, page = table.to_markdown(), str(renderer.sweep(board, sweep).content)
    assert '<td class="difference worse"' in page and '\N{MINUS SIGN}10.0 ± 0.0<span class="note">paper' in page
    assert '<span class="note">1 of 2</span>' in page and "loss/total is &lt;nan&gt;" in page
    for cell in (cell for cells in rows for cell in cells):
        assert cell.text in markdown
        assert cell.text.replace("-", "\N{MINUS SIGN}").partition(" (")[0] in page


def test_rows_with_baselines_of_their_own_show_their_differences(board):
    (table,) = board.sweep("epsilon_mini").tables
    first, second, third = table.rows
    table = dataclasses.replace(table, rows=[
        dataclasses.replace(row, baseline=baseline)
        for row, baseline in ((first, second.label), (second, second.label), (third, third.label))
    ])  # fmt: skip
    texts = [list(table.shown(row))[2].text for row in table.rows]
    assert texts[0].startswith("-10.0") and texts[1:] == ["baseline", "baseline"]


def test_headline(board):
    assert headline(board.sweep("epsilon_mini")) == "Best mAP here: 4.8 m, 41.0 ± 1.4. In the paper: 4.8 m, 22.8."


def test_labels_are_never_markup(board, renderer):
    page = renderer.document(board, [renderer.sweep(board, board.sweep("epsilon_mini"))])
    assert "<script>alert" not in page and str(escape(EVIL)) in page
    assert page.count("<script>") == 1  # the dashboard's own
    for run in board.runs.values():
        assert "<script>alert" not in renderer.run(board, run).content


def test_failed_runs_stand_with_reason_and_log(board, renderer, shared_world):
    content = renderer.sweep(board, board.sweep("epsilon_mini")).content
    assert "loss/total is &lt;nan&gt;" in content and "DivergedError: loss/total is nan" in content
    assert str(shared_world.outputs) not in content


def test_a_run_without_numbers_does_not_show_those_of_its_baseline(board, renderer, shared_world):
    run = board.runs[shared_world.run_id(1, 1)]
    assert board.baseline_of(run) is not None
    assert "<svg" not in renderer.run(board, run).content
    against = board.runs[shared_world.run_id(2, 1)]
    held = renderer.run(board, run, against).content
    assert "seed 1 (phase1 00000021)</text>" in held  # the legend says whose they are


def test_every_id_stands_once(board, renderer):
    pages = [renderer.overview(board), *(renderer.sweep(board, sweep) for sweep in board.sweeps)]
    pages += [renderer.run(board, run) for run in board.runs.values()]
    ids = re.findall(r'\bid="([^"]+)"', renderer.document(board, pages))
    assert len(ids) == len(set(ids))
    assert all(" " not in name for name in ids)


def test_metrics_beside_another_run(board, shared_world):
    run, other = board.runs[shared_world.run_id(0, 0)], board.runs[shared_world.run_id(2, 0)]
    rows = {row.metric.name: row for group in metric_rows(run, other).values() for row in group}
    assert (rows["mAP"].value, rows["mAP"].other, rows["mAP"].difference) == ("30.0", "40.0", "\N{MINUS SIGN}10.0")
    assert rows["mAP"].verdict == "worse"
    assert (rows["mAVE"].value, rows["mAVE"].difference, rows["mAVE"].verdict) == ("1.70", "+0.10", "worse")
    assert set(metric_rows(run, None)) == {"Summary", "By distance", "By speed", "By class"}
    same = metric_rows(run, run)["Summary"][0]
    assert (same.difference, same.verdict) == ("+0.0", "")
    assert metric_rows(board.runs[shared_world.run_id(1, 1)], other) == {}  # it failed


def test_configurations_as_lines():
    tree = {"a": {"b": 1, "c": [1, 2], "d": {}, "e": None}, "f": True, "g": "two\nlines"}
    flat = flat_config(tree)
    assert flat == [("a.b", "1"), ("a.c", "[1, 2]"), ("a.e", "null"), ("f", "true"), ("g", "two lines")]
    other = flat_config({"a": {"b": 2, "c": [1, 2], "e": None}, "f": True})
    assert config_difference(flat, other) == [("a.b", "1", "2"), ("g", "two lines", "\N{EN DASH}")]
    assert flat_config({}) == [] and flat_config({1: 1, 0: 0}) == [("1", "1"), ("0", "0")]


def test_signs():
    assert [signed(v, 1) for v in (1.25, -0.5)] == ["+1.2", "\N{MINUS SIGN}0.5"]
