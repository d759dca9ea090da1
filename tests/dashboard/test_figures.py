"""Which numbers go into which figure."""

import time
import xml.etree.ElementTree as ET

from src.dashboard.board import Sweep
from src.dashboard.figures import (
    curve_figures,
    knob_figures,
    latency_figures,
    results_by_row,
    run_figures,
    search_figures,
    sweep_figures,
)
from src.report.sweep_file import DimensionConfig, SweepConfig
from src.report.sweep_record import RunState, SweepRecord
from tests.dashboard.experiments import EVIL, World


def notes(figure):
    """What the points say, the legend's apart."""
    svg = ET.fromstring(str(figure)).find("svg")
    titles = [mark.find("title") for mark in svg.iter() if {"mark", "bar"} & set((mark.get("class") or "").split())]
    return [title.text for title in titles if title is not None and title.text]


def caption(figure):
    return ET.fromstring(str(figure)).find("figcaption").text


def test_a_knob_has_two_figures_and_never_one_axis_for_two_data_sets(board):
    sweep = board.sweep("epsilon_mini")
    here, paper = knob_figures(sweep, sweep.record.sweep.plots[0], results_by_row(board, sweep))
    assert "here, scale mini" in caption(here) and "paper" in caption(paper)
    assert notes(here) == ["0.8 m: 31.0 [29.0, 34.0]", f"{EVIL}: 35.0 [33.0, 38.0]", "4.8 m: 41.0 [39.0, 44.0]"]
    assert notes(paper) == ["0.8 m: 18.8", f"{EVIL}: 21.2", "4.8 m: 22.8"]


def test_rows_without_a_place_are_bars(board):
    sweep = board.sweep("epsilon_mini")
    results, plot = results_by_row(board, sweep), sweep.record.sweep.plots[0]
    sweep.record.sweep.rows[1].x = None
    here, paper = knob_figures(sweep, plot, results)
    assert notes(here) == ["0.8 m: 31.0 [29.0, 34.0]", f"{EVIL}: 35.0 [33.0, 38.0]", "4.8 m: 41.0 [39.0, 44.0]"]
    for row in sweep.record.sweep.rows:
        row.paper = {}
    assert len(knob_figures(sweep, plot, results)) == 1  # the paper says nothing


def test_sections_of_a_sweep_and_of_a_run(board):
    sections = sweep_figures(board, board.sweep("epsilon_mini"))
    assert [(title, [caption(f) for f in figures]) for title, figures in sections.items()][1:] == [
        ("By distance, speed and class", ["mAP by distance", "mAP by speed", "AP by class"]),
        ("Learning curves", ["mAP while training", "Training loss"]),
    ]
    run = board.runs[World.run_id(0, 0)]
    assert "mAP by distance" in [
        caption(f) for f in run_figures(board, {"this run": run})["By distance, speed and class"]
    ]
    failed = board.runs[World.run_id(1, 1)]
    assert run_figures(board, {"this run": failed}) == {}


def test_latency_against_accuracy_shows_rows_that_were_timed(board):
    sweep = board.sweep("epsilon_mini")
    results = results_by_row(board, sweep)
    assert latency_figures(sweep, results) == []
    for result in results["4.8 m"]:
        result.metrics["latency.total"] = 250.0 + 10 * result.seed
    assert latency_figures(sweep, results) == []  # one point is no comparison
    other = next(label for label in results if label != "4.8 m" and results[label])
    for result in results[other]:
        result.metrics["latency.total"] = 100.0
    (figure,) = latency_figures(sweep, results)
    assert "4.8 m: 255.0 ms, 41.0 NDS" in notes(figure) and len(notes(figure)) == 2


def test_runs_of_a_row_share_their_look():
    curve = {"loss/total": [(1, 5.0), (2, 4.0)]}
    (figure,) = curve_figures({"a": [curve, curve], "b": [curve]})
    svg = ET.fromstring(str(figure)).find("svg")
    groups = [g.get("class") for g in svg.findall("g") if g.get("class")]
    assert groups == ["s0", "s0", "s1"]
    legend = [g.find("text").text for g in svg.findall("g") if g.get("transform")]
    assert legend == ["a", "b"]
    # The loss of every step is drawn only as long as there is none of an epoch.
    assert len(curve_figures({"a": [curve | {"step/total": [(1, 9.0)]}]})) == 1
    assert len(curve_figures({"a": [{"step/total": [(1, 9.0)]}]})) == 1


def test_a_search_is_drawn_trial_by_trial():
    space = {"optim.lr": DimensionConfig(low=1e-5, high=1e-3, log=True), "model.x": DimensionConfig(choices=["a", "b"])}
    search = SweepConfig(name="tune", title="t", question="q", space=space, objective="NDS", trials=4)
    runs = {
        f"r{n}": RunState(run_id=f"r{n}", overrides=[f"optim.lr={lr}", "model.x=a"], seed=0, label=f"trial {n}",
                          state="done", value=value, ended=float(n))
        for n, (lr, value) in enumerate([(1e-5, 0.3), (1e-4, 0.5), (1e-3, 0.4), (1e-4, None)])
    }  # fmt: skip
    record = SweepRecord(sweep=search, scale="mini", command="c", seeds=[0], rows={}, runs=runs, study="s", storage="s")
    now = time.time()
    by_trial, by_rate = search_figures(Sweep(record=record, tables=[], problem=None, written=now, now=now))
    assert notes(by_trial)[:3] == ["trial 0", "trial 1", "trial 2"]
    assert notes(by_trial)[3:] == ["best so far: 30", "best so far: 50", "best so far: 50"]
    assert caption(by_rate) == "NDS by optim.lr" and len(notes(by_rate)) == 3
