"""Numbers and words of the pages: tables as in the files, differences, configurations."""

import dataclasses
import re

import pytest
from markupsafe import escape

from src.dashboard.figures import headline
from src.dashboard.render import (
    Renderer,
    config_difference,
    flat_config,
    metric_rows,
    number,
    signed,
)
from src.report.escaping import escape_markdown
from src.report.metric_names import METRICS
from tests.dashboard.experiments import EVIL


@pytest.fixture
def renderer():
    return Renderer(lambda kind, name="": f"/{kind}/{name}", lambda picture: f"/pictures/{picture.name}", live=True)


def test_tables_hold_the_numbers_of_the_files(board, renderer):
    sweep = board.sweep("epsilon_mini")
    (table,) = sweep.tables
    assert [head.text for head in table.heads] == ["mAP, %", "mAP to baseline", "mAVE, m/s", "mAVE to baseline"]
    # Rows 30 and 32, 35 alone (the other seed failed), 40 and 42: means 31, 35, 41, two pairs of seeds that agree.
    rows = [cells for _, cells in table.lines]
    assert [cells[0].here for cells in rows] == ["31.0 [29.0, 34.0]", "35.0 [33.0, 38.0]", "41.0 [39.0, 44.0]"]
    assert [cells[0].best for cells in rows] == [False, False, True], "of those whose seeds have all finished"
    assert [(cells[1].paper, cells[1].here) for cells in rows] == [
        ("-4.0", "-10.0 [-10.0, -10.0]"), ("-1.6", "-5.0 undecided"), (None, "baseline")
    ]  # fmt: skip
    assert [cells[1].verdict for cells in rows] == ["worse", "", ""]
    assert rows[0][3].verdict == "worse"  # a larger error
    markdown, page = table.to_markdown(), str(renderer.sweep(board, sweep).content)
    assert '<td class="worse"' in page and "1 of 2 seeds" in page and "loss/total is &lt;nan&gt;" in page
    for cell in (cell for cells in rows for cell in cells):
        assert cell.text(escape_markdown, "**{}**".format) in markdown
        value, _, interval = cell.here.partition(" [")
        assert value in page and (not interval or f'<span class="note">[{interval}</span>' in page)


def test_wide_tables_have_metrics_as_lines_on_pages_too(board, renderer):
    sweep = board.sweep("epsilon_mini")
    (table,) = sweep.tables
    wide = dataclasses.replace(
        table, columns=table.columns * 4, rows=[dataclasses.replace(row, cells=row.cells * 4) for row in table.rows]
    )
    assert wide.transposed
    page = str(renderer.sweep(board, dataclasses.replace(sweep, tables=[wide])).content)
    head = page[page.index("<thead>") : page.index("</thead>")]
    assert head.count("<th ") == 1 + 3 and "4.8 m" in head and 'title="run of seed 0"' in head
    assert page[page.index("<tbody>") : page.index("</tbody>")].count("<tr ") == 8


def test_rows_with_baselines_of_their_own_show_their_differences(board):
    (table,) = board.sweep("epsilon_mini").tables
    first, second, third = table.rows
    table = dataclasses.replace(table, rows=[
        dataclasses.replace(row, baseline=baseline)
        for row, baseline in ((first, second.label), (second, second.label), (third, third.label))
    ])  # fmt: skip
    texts = [cells[1].here for _, cells in table.lines]
    assert texts[0].startswith("-10.0") and texts[1:] == ["baseline", "baseline"]


def test_headline(board):
    sweep = board.sweep("epsilon_mini")
    assert headline(sweep) == "Best mAP here: 4.8 m, 41.0 [39.0, 44.0]. In the paper: 4.8 m, 22.8."
    (table,) = sweep.tables
    table.rows[2].cells[0].best = False
    assert headline(sweep) == "Best mAP here: undecided. In the paper: 4.8 m, 22.8."
    alone = dataclasses.replace(table, rows=table.rows[:1])
    assert headline(dataclasses.replace(sweep, tables=[alone])).startswith("Best mAP here: 0.8 m, 31.0 [29.0, 34.0].")


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


def test_a_number_that_rounds_to_zero_has_no_sign():
    metric = METRICS["mAVE"]
    assert [number(value, metric) for value in (-0.0002, 0.5, None)] == ["0.00", "0.50", ""]


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
    assert (rows["mAVE"].value, rows["mAVE"].difference) == ("1.70", "+0.10")
    assert (rows["mAP"].interval, rows["mAVE"].interval) == ("28.0 – 33.0", "")
    assert "measures.history_near" not in rows and rows["measures.moving_AP"].value == "30.0"
    assert set(metric_rows(run, None)) == {"Summary", "What a memory is for", "By distance", "By speed", "By class"}
    assert metric_rows(run, run)["Summary"][0].difference == "+0.0"
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
