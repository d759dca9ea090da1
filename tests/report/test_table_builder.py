"""Tables of sweeps: numbers done by hand, rows without them, what is refused, and the three forms."""

import csv
import io
import json
import re

import pytest

from src.errors import DataError
from src.report.escaping import as_code, escape_latex, escape_markdown
from src.report.metric_names import METRICS
from src.report.results import read_results, result_path
from src.report.sweep_file import DimensionConfig, SweepConfig
from src.report.sweep_record import RunState, SweepRecord
from src.report.table_builder import sweep_tables, write_sweep_tables
from src.sweep.compose import load_sweep, sweep_files

PREFIX = "horizon3d-phase1-mini-"


@pytest.fixture
def results_of(make_result):
    """Results by the end of the run id: mAP as a fraction, NDS twice that, the velocity error 1 minus it."""

    def make(values, **changes):
        return {
            f"{PREFIX}{end}": make_result(
                f"{PREFIX}{end}", {"mAP": value, "NDS": 2 * value, "mAVE": 1 - value}, int(end[1:]), **changes
            )
            for end, value in values.items()
        }

    return make


THREE = {"a0": 0.20, "a1": 0.22, "a2": 0.24, "b0": 0.25, "b1": 0.26, "b2": 0.30}


def cells_of(markdown):
    """Cells of the table by row label."""
    lines = [line for line in markdown.splitlines() if line.startswith("| ")]
    return {line.split(" | ")[0].strip("| "): re.split(r"(?<!\\)\|", line)[2:-1] for line in lines}


def test_means_spreads_and_differences_by_hand(make_record, results_of):
    record = make_record({"small": {"mAP": 18.6}, "large": {"mAP": 20.3}}, columns=("mAP", "mAVE"), baseline="large")
    (table,) = sweep_tables(record, results_of(THREE))
    (small, error), (large, _) = (row.cells for row in table.rows)
    assert small.mean == pytest.approx(22.0) and small.spread == pytest.approx(2.0) and small.seeds == 3
    assert large.mean == pytest.approx(27.0) and large.spread == pytest.approx(2.6457513)
    # small minus large by seed: -5, -4, -6, far steadier than the rows themselves
    assert small.difference == pytest.approx(-5.0) and small.difference_spread == pytest.approx(1.0)
    assert small.paper_difference == -1.7
    assert large.best and not small.best and large.paper_best and not small.paper_best
    assert error.mean == pytest.approx(0.78) and error.difference == pytest.approx(0.05)  # m/s, not percent
    text = cells_of(table.to_markdown())
    assert text["small"] == [" 18.6 ", " 22.0 ± 2.0 ", " -5.0 ± 1.0 (paper -1.7) ", " 0.78 ± 0.02 ",
                             " +0.05 ± 0.01 ", " 3 "]  # fmt: skip
    assert text["large"] == [" **20.3** ", " **27.0 ± 2.6** ", " baseline ", " **0.73 ± 0.03** ", " baseline ", " 3 "]
    assert "mAP, %: paper" in table.to_markdown() and "mAVE, m/s: paper" not in table.to_markdown()


def test_the_smaller_error_is_bold_and_a_tie_of_all_is_not(make_record, results_of):
    record = make_record({"a": {}, "b": {}}, seeds=1, columns=("mAVE",))
    (table,) = sweep_tables(record, results_of({"a0": 0.2, "b0": 0.3}))
    assert [row.cells[0].best for row in table.rows] == [False, True]  # 0.8 and 0.7
    (table,) = sweep_tables(record, results_of({"a0": 0.2, "b0": 0.2}))
    assert [row.cells[0].best for row in table.rows] == [False, False]


def test_a_row_may_have_a_baseline_of_its_own(make_record, results_of):
    record = make_record({"a": {"mAP": 1.0}, "b": {"mAP": 3.0}, "c": {}, "d": {}}, seeds=1, columns=("mAP",))
    for row, baseline in zip(record.sweep.rows, "bbdd", strict=True):
        row.baseline = baseline
    (table,) = sweep_tables(record, results_of({"a0": 0.1, "b0": 0.2, "c0": 0.4, "d0": 0.1}))
    text = cells_of(table.to_markdown())
    assert [text[label][2] for label in "abcd"] == [" -10.0 (paper -2.0) ", " baseline ", " +30.0 ", " baseline "]
    assert table.baselines == ["b", "d"]
    assert "Differences are to b or d, seed by seed; the paper's in brackets." in table.caption
    assert [sentence[:18] for sentence in table.text[2:4]] == ["mAP, a against b: ", "mAP, c against d: "]


def test_a_table_may_show_some_of_the_rows(make_record, results_of):
    record = make_record({"a": {"mAP": 9.0}, "b": {"mAP": 3.0}, "c": {}}, seeds=1, columns=("mAP",), baseline="b",
                         paper_rows={"other": {"mAP": 4.0}, "best": {"mAP": 8.0}})  # fmt: skip
    record.sweep.tables[0].rows = ["other", "c", "best"]
    (table,) = sweep_tables(record, results_of({"a0": 0.1, "b0": 0.2, "c0": 0.4}))
    text = cells_of(table.to_markdown())
    assert list(text) == ["row", "other", "c", "best"]
    assert text["c"] == [" – ", " 40.0 ", " +20.0 ", " 1 "]  # to the baseline that is not shown
    assert text["other"] == [" 4.0 ", " – ", " – (paper +1.0) ", " – "]
    assert text["best"][0] == " **8.0** "


def test_one_seed_has_no_spread_and_says_so(make_record, results_of):
    (table,) = sweep_tables(make_record({"a": {}, "b": {}}, seeds=1), results_of({"a0": 0.2, "b0": 0.3}))
    assert "±" not in table.to_markdown() and "seed 0: one seed, so no spread" in table.caption


def test_the_caption_names_what_was_run(make_record, results_of):
    results = results_of(THREE)
    results[f"{PREFIX}b2"].commit = "fedcba9876543210+"
    for seed in range(3):
        results[f"{PREFIX}b{seed}"].phase, results[f"{PREFIX}b{seed}"].epochs = "phase2", 1
    results[f"{PREFIX}a0"].latency = {"processor": "Fast CPU", "threads": 1, "ms": {}}
    (table,) = sweep_tables(make_record({"a": {}, "b": {}}), results)
    assert table.caption == (
        "Data: synthetic highway world, split val; scale mini; phase1: 6 epochs; phase2: 1 epoch; seeds 0, 1, 2: "
        "mean ± standard deviation; code 0123456789, fedcba9876+; cpu, 1 process of 2 threads."
    )
    (table,) = sweep_tables(make_record({"a": {}, "b": {}}, columns=("mAP", "latency.total")), results)
    assert table.caption.endswith("2 threads. Latency on Fast CPU, 1 thread.")


def test_rows_without_numbers_say_why(make_record, results_of):
    states = {
        "a1": {"state": "failed", "reason": "loss is nan", "log": "logs/a1.txt"},
        "b0": {"state": "failed", "reason": "no | memory", "log": "logs/b0.txt"},
        "b1": {"state": "running"},
        "c0": {"state": "running"}, "c1": {"state": "waiting"},
        "d0": {"state": "waiting"}, "d1": {"state": "waiting"},
    }  # fmt: skip
    record = make_record(dict.fromkeys("abcde", {"mAP": 20.0}), seeds=2, columns=("mAP",), states=states)
    (table,) = sweep_tables(record, results_of({"a0": 0.3, "e0": 0.1}))
    text = cells_of(table.to_markdown())
    assert text["a"] == [" 20.0 ", " 30.0 ", " 1 of 2 ", " failed: loss is nan (logs/a1.txt), seed 1 "]
    assert text["b"][1:3] == [" – ", " 0 of 2 "]
    assert text["b"][3] == " failed: no \\| memory (logs/b0.txt), seed 0; running "
    assert text["c"][3] == " running; not run yet " and text["d"][3] == " not run yet "
    assert text["e"][3] == f" result missing or not readable: results/{PREFIX}e1.json, seed 1 "
    assert [row.state for row in table.rows] == ["failed", "failed", "running", "waiting", "failed"]
    assert not any(cell.best for row in table.rows for cell in row.cells)  # no row is whole
    assert "Bold is the best of the rows whose seeds have all finished." in table.caption


def test_numbers_of_an_earlier_training_are_marked_and_do_not_count(make_record, results_of):
    states = {
        "b0": {"state": "failed", "reason": "loss is nan", "log": "logs/b0.txt"},
        "c0": {"state": "running"}, "d0": {"state": "waiting"},
    }  # fmt: skip
    record = make_record(dict.fromkeys("abcd", {}), seeds=1, columns=("mAP",), states=states)
    (table,) = sweep_tables(record, results_of({"a0": 0.1, "b0": 0.2, "c0": 0.3, "d0": 0.4}))
    assert [row.state for row in table.rows] == ["done", "failed", "running", "waiting"]
    assert [row.done for row in table.rows] == [1, 0, 0, 0]
    assert [row.note for row in table.rows] == [
        "", "failed again: loss is nan (logs/b0.txt); the number is of an earlier training",
        "running; the number is of an earlier training", "waiting; the number is of an earlier training",
    ]  # fmt: skip
    text = cells_of(table.to_markdown())
    assert text["d"][:2] == [" 40.0 (n = 1) ", " 0 of 1 "] and "**" not in table.to_markdown()


def test_a_result_of_another_seed_is_refused_by_name(make_record, results_of):
    results = results_of({"a0": 0.1, "a1": 0.2})
    results[f"{PREFIX}a1"].seed = 7
    with pytest.raises(DataError, match=f"{PREFIX}a1 stands for seed 1, but its result is of seed 7"):
        sweep_tables(make_record({"a": {}}, seeds=2), results)


@pytest.mark.parametrize(
    "changes",
    [{"overrides": ["model.x=2"]}, {"config": {"seed": 1, "x": 2}}, {"phase": "phase2"}, {"model": "other"}],
)
def test_a_row_never_mixes_configurations(make_record, results_of, changes):
    results = results_of({"a0": 0.1}) | results_of({"a1": 0.2}, **changes)
    with pytest.raises(DataError, match=f"row a: .*{PREFIX}a0 and {PREFIX}a1 differ in more than their seed"):
        sweep_tables(make_record({"a": {}}, seeds=2), results)


def test_a_setting_that_was_typed_though_it_is_the_default_is_the_same(make_record, results_of):
    results = results_of({"a0": 0.1}, config={"seed": 0, "x": 1})
    results |= results_of({"a1": 0.2}, config={"seed": 1, "x": 1}, overrides=["x=1"])
    assert sweep_tables(make_record({"a": {}}, seeds=2), results)[0].rows[0].done == 2


def test_verdicts_are_about_the_digits_shown(make_record, results_of):
    paper = {"a": {"mAP": 18.0}, "b": {"mAP": 18.04}, "c": {"mAP": 10.0}}
    record = make_record(paper, seeds=1, columns=("mAP",), baseline="b")
    (table,) = sweep_tables(record, results_of({"a0": 0.20001, "b0": 0.20003, "c0": 0.1}))
    assert table.text[1] == (
        "mAP: 2 of the paper's 3 orderings of two rows hold here in the mean, 1 ties at the digits shown."
    )
    assert table.text[2].startswith("mAP, a against b: paper -0.04, here +0.0, no difference at the digits shown; ")
    assert [row.cells[0].best for row in table.rows] == [True, True, False]  # a tie as shown
    assert "-0.0 " not in table.to_markdown()


def test_the_one_ordering_may_be_a_tie(make_record, results_of):
    record = make_record({"a": {"mAP": 18.0}, "b": {"mAP": 19.0}}, seeds=1, columns=("mAP",))
    (table,) = sweep_tables(record, results_of({"a0": 0.2, "b0": 0.20004}))
    assert table.text[1] == ("mAP: the paper's one ordering of two rows ties at the digits shown in the mean.")
    assert [row.cells[0].best for row in table.rows] == [False, False]


def timed(result, total, spread, **load):
    """The result with a latency of this total and range of the middle half."""
    result.latency = {"ms": {"total": total}, "spread_ms": {"total": spread}, "processor": "CPU", "threads": 1} | load
    result.metrics |= {"latency.total": total, "latency.fps": 1e3 / total}


def test_a_latency_of_one_run_shows_the_spread_of_its_frames(make_record, results_of):
    record = make_record({"a": {}, "b": {}}, seeds=1, columns=("latency.total", "latency.fps"))
    results = results_of({"a0": 0.1, "b0": 0.1})
    timed(results[f"{PREFIX}a0"], 250.0, 20.0)
    timed(results[f"{PREFIX}b0"], 200.0, 40.0, load=3.0, cores=4)
    (table,) = sweep_tables(record, results)
    text = cells_of(table.to_markdown())
    assert text["a"][:2] == [" 250.0 ± 10.0 ", " 4.00 ± 0.16 "] and text["b"][0] == " **200.0 ± 20.0** "
    assert "half the range of the middle half of its frames" in table.caption
    assert "Latency on CPU, 1 thread, measured on a busy machine" in table.caption
    timed(results[f"{PREFIX}b0"], 225.0, 40.0, load=1.0, cores=4)  # 25 apart, within 10 + 20
    (table,) = sweep_tables(record, results)
    assert not any(cell.best for row in table.rows for cell in row.cells) and "busy" not in table.caption


def test_a_failed_single_run_stands_as_failed(make_record, results_of):
    states = {"b0": {"state": "failed", "reason": "out of memory", "log": "logs/b.txt"}}
    (table,) = sweep_tables(make_record({"a": {}, "b": {}}, seeds=1, states=states), results_of({"a0": 0.1}))
    assert table.rows[1].note == "failed: out of memory (logs/b.txt)"


def test_nothing_has_run(make_record):
    states = {end: {"state": "waiting"} for end in ("a0", "b0")}
    record = make_record({"a": {"mAP": 1.0}, "b": {}}, seeds=1, states=states, baseline="a")
    (table,) = sweep_tables(record, {})
    assert table.text == ["No run has finished yet."] and "Data: no run has finished yet" in table.caption
    for text in (table.to_markdown(), table.to_csv(), table.to_latex()):
        assert "not run yet" in text


def test_rows_of_the_paper_alone(make_record, results_of):
    record = make_record({"ours": {"mAP": 23.6}}, seeds=1, columns=("mAP", "latency.fps"),
                         paper_rows={"BEVFusion": {"mAP": 18.2, "latency.fps": 4.2}})  # fmt: skip
    (table,) = sweep_tables(record, results_of({"a0": 0.3}))
    text = cells_of(table.to_markdown())
    assert text["BEVFusion"] == [" 18.2 ", " – ", " 4.20 ", " – ", " – "]
    assert text["ours"] == [" **23.6** ", " 30.0 ", " – ", " – ", " 1 "]  # never measured: a dash
    assert table.text[1] == "One row is trained here, so there is nothing to compare it with."
    record.sweep.baseline = "ours"
    assert cells_of(sweep_tables(record, results_of({"a0": 0.3}))[0].to_markdown()) == text  # no empty columns


def test_latency_of_fewer_runs_says_of_how_many(make_record, results_of):
    results = results_of({"a0": 0.3, "a1": 0.3})
    results[f"{PREFIX}a1"].metrics["latency.total"] = 117.7
    (table,) = sweep_tables(make_record({"a": {}}, seeds=2, columns=("latency.total",)), results)
    assert cells_of(table.to_markdown())["a"][0] == " 117.7 (n = 1) "


def test_differences_say_over_how_many_seeds(make_record, results_of):
    states = {"b1": {"state": "waiting"}, "b2": {"state": "waiting"}}
    record = make_record({"a": {}, "b": {}}, columns=("mAP",), baseline="b", states=states)
    (table,) = sweep_tables(record, results_of({"a0": 0.2, "a1": 0.3, "a2": 0.4, "b0": 0.1}))
    assert table.rows[0].cells[0].differences == {0: pytest.approx(10.0)}
    assert "+10.0 (n = 1)" in table.to_markdown()


@pytest.mark.parametrize(
    "changes",
    [
        {"data": {"name": "synthetic highway", "root": "elsewhere", "split": "val"}},
        {"data": {"name": "synthetic highway", "root": "world", "split": "test"}},
        {"scale": "debug"},
    ],
)
def test_different_data_or_scales_are_refused_by_name(make_record, results_of, changes):
    record = make_record({"a": {}, "b": {}}, seeds=1)
    results = results_of({"a0": 0.1}) | results_of({"b0": 0.2}, **changes)
    with pytest.raises(DataError, match=rf"sweep epsilon.*never mixes.*{PREFIX}a0 \(.*{PREFIX}b0 \(.*delete"):
        sweep_tables(record, results)
    other = results.pop(f"{PREFIX}b0")
    assert sweep_tables(record, results | {"of-no-row": other})


def test_results_of_another_scale_alone_are_refused(make_record, results_of):
    with pytest.raises(DataError, match="sweep epsilon, scale mini: .*scale debug"):
        sweep_tables(make_record({"a": {}}, seeds=1), results_of({"a0": 0.1}, scale="debug"))


def test_orderings_of_the_paper_in_words(make_record, results_of):
    record = make_record({"a": {"mAP": 18.0}, "b": {"mAP": 20.0}, "c": {"mAP": 19.0}}, columns=("mAP",), baseline="b")
    (table,) = sweep_tables(record, results_of(THREE | {"c0": 0.26, "c1": 0.27, "c2": 0.29}))
    frame, counted, a, c, hint = table.text
    assert "synthetic highway" in frame and "not results on TruckScenes" in frame
    assert "reproduc" not in " ".join(table.text).lower()
    assert counted == (
        "mAP: 2 of the paper's 3 orderings of two rows hold here in the mean; those that do not: b before c."
    )
    # a minus b: -5, -4, -6
    assert a == (
        "mAP, a against b: paper -2.0, here -5.0 ± 1.0, in the paper's order; 3 of 3 seeds on the paper's side "
        "(sign test n = 3, p = 0.25)."
    )
    # c minus b: +1, +1, -1
    assert c == (
        "mAP, c against b: paper -1.0, here +0.3 ± 1.2, not in the paper's order; 1 of 3 seeds on the paper's side "
        "(sign test n = 3, p = 1)."
    )
    assert "With 3 seeds no sign test can decide at 5 %" in hint and "6 seeds" in hint
    for sentence in table.text:
        assert sentence in table.to_markdown()


def test_several_tests_that_can_decide_say_that_they_are_several(make_record, results_of):
    record = make_record({"a": {}, "b": {}, "c": {}}, seeds=6, columns=("mAP",), baseline="a")
    values = {f"{label}{seed}": 0.1 * place for place, label in enumerate("abc") for seed in range(6)}
    (table,) = sweep_tables(record, results_of(values))
    assert table.text[-1] == "The p-values of these 2 sign tests are not corrected for their number."


def test_six_seeds_can_decide_and_need_no_hint(make_record, results_of):
    record = make_record({"a": {"mAVE": 0.6}, "b": {"mAVE": 0.9}}, seeds=6, columns=("mAVE",))  # no baseline
    values = {f"a{seed}": 0.5 for seed in range(6)} | {f"b{seed}": 0.3 for seed in range(6)}
    (table,) = sweep_tables(record, results_of(values))
    assert table.text[-1] == (
        "mAVE, a against b: paper -0.30, here -0.20 ± 0.00, in the paper's order; 6 of 6 seeds on the paper's side "
        "(sign test n = 6, p = 0.031)."
    )


def test_rows_that_the_paper_does_not_have(make_record, results_of):
    record = make_record({"a": {}, "b": {}}, columns=("mAP",), baseline="b")
    (table,) = sweep_tables(record, results_of(THREE))
    frame, compared, _ = table.text
    assert "the paper has no numbers for these rows" in frame
    assert compared == "mAP, a against b: here -5.0 ± 1.0; 0 of 3 seeds better (sign test n = 3, p = 0.25)."


def test_real_data_are_not_called_synthetic(make_record, results_of):
    data = {"name": "man-truckscenes", "root": "man-truckscenes", "split": "val"}
    (table,) = sweep_tables(make_record({"a": {"mAP": 1.0}}, seeds=1), results_of({"a0": 0.1}, data=data))
    assert "synthetic" not in table.to_markdown() and "not the paper's size" in table.text[0]


NASTY = "<script>alert(1)</script> a|b \\ 50% x_y & #1 *ε*"


def test_labels_are_shown_and_never_obeyed(make_record, results_of):
    record = make_record({NASTY: {"mAP": 1.0}, "b": {}}, seeds=1)
    (table,) = sweep_tables(record, results_of({"a0": 0.1, "b0": 0.2}))
    markdown, latex = table.to_markdown(), table.to_latex()
    assert "<script>" not in markdown
    assert "&lt;script&gt;alert(1)&lt;/script&gt; a\\|b \\\\ 50% x_y &amp; #1 \\*ε\\*" in markdown
    assert len({len(re.split(r"(?<!\\)\|", line)) for line in markdown.splitlines() if line.startswith("|")}) == 1
    assert "a\\textbar{}b \\textbackslash{} 50\\% x\\_y \\& \\#1 *$\\varepsilon$*" in latex
    assert "\\begin{tabular}{lrrrl}" in latex and "\\toprule" in latex and "\\multicolumn{2}{c}{mAP, \\%}" in latex
    assert "\\cmidrule(lr){2-3} \\cmidrule(lr){4-4}" in latex
    body = latex.split("\\midrule")[1].split("\\bottomrule")[0].strip().splitlines()
    assert [len(re.split(r"(?<!\\)&", line)) for line in body] == [5, 5]
    first, _ = list(csv.DictReader(io.StringIO(table.to_csv())))
    assert first["row"] == NASTY


def test_escaping_of_single_marks():
    assert escape_markdown("a\nb`[x](y)") == "a b\\`\\[x\\](y)"
    assert escape_latex("{1}~2^3 ± – $") == "\\{1\\}\\textasciitilde{}2\\textasciicircum{}3 $\\pm$ -- \\$"
    assert as_code(["a=`x`", "b=1|2"]) == "`a='x' b=1\\|2`"


def test_csv_holds_plain_numbers(make_record, results_of):
    record = make_record({"a": {"mAP": 18.6}, "b": {"mAP": 20.3}, "c": {}}, columns=("mAP",), baseline="b",
                         states={"c0": {"state": "waiting"}})  # fmt: skip
    (table,) = sweep_tables(record, results_of(THREE))
    a, b, c = csv.DictReader(io.StringIO(table.to_csv()))
    assert (a["mAP paper"], a["mAP mean"], a["mAP std"], a["mAP n"]) == ("18.6", "22.0", "2.0", "3")
    assert (a["mAP diff"], a["mAP diff std"], a["mAP diff n"], a["mAP paper diff"]) == ("-5.0", "1.0", "3", "-1.7")
    assert b["mAP diff"] == "" and c["mAP mean"] == c["mAP paper"] == "" and c["mAP n"] == "0"
    assert (c["state"], c["seeds done"], c["seeds planned"]) == ("failed", "0", "3")


def test_files_are_written_from_the_results_that_can_be_read(make_record, make_result, write_result, tmp_path):
    reports = tmp_path / "reports"
    record = make_record({"a": {}, "b": {}}, seeds=1)
    for end, value in (("a0", 0.1), ("b0", 0.2)):
        write_result(make_result(f"{PREFIX}{end}", {"mAP": value, "NDS": value}))
    result_path(reports, f"{PREFIX}b0").write_text("{")
    paths = write_sweep_tables(reports, record, read_results(reports)[0])
    assert [path.name for path in paths] == [f"table_epsilon_mini.{ending}" for ending in ("md", "csv", "tex")]
    text = paths[0].read_text()
    assert "| a | 10.0 |" in text and "result missing or not readable" in text
    assert {path.name for path in (reports / "tables").iterdir()} == {path.name for path in paths}


def test_results_that_are_given_are_taken(make_record, results_of, tmp_path):
    write_sweep_tables(tmp_path, make_record({"a": {}}, seeds=1), results_of({"a0": 0.25}))
    assert "| a | 25.0 |" in (tmp_path / "tables" / "table_epsilon_mini.md").read_text()


def test_a_search_lists_its_trials_best_first(make_result):
    sweep = SweepConfig(
        title="Search", question="Which?", name="tune", objective="NDS", trials=6,
        space={"optim.lr": DimensionConfig(low=1e-5, high=1e-3),
               "model.loss.ocsf_weight": DimensionConfig(choices=[1, 5])},
    )  # fmt: skip
    runs = {"source": RunState(run_id="source", overrides=[], seed=0, label="phase 1", state="done")}
    for number, (state, value) in enumerate(
        [("done", 0.3), ("pruned", 0.2), ("done", 0.5), ("failed", None), ("waiting", None), ("running", None)]
    ):
        runs[f"t{number}"] = RunState(
            run_id=f"t{number}", seed=0,
            overrides=["phase=phase2", f"optim.lr={number}e-4", "model.loss.ocsf_weight=5"],
            label=f"trial {number}", needs="source", state=state, value=value, reason="loss is nan", log="t.txt",
        )  # fmt: skip
    record = SweepRecord(sweep=sweep, scale="mini", command="", seeds=[0], rows={}, runs=runs, study="", storage="")
    results = {name: make_result(name, {"NDS": runs[name].value}) for name in ("t0", "t2")}
    (table,) = sweep_tables(record, results)
    assert [row.label for row in table.rows] == [f"trial {n}" for n in (2, 0, 1, 3, 5, 4)]
    text = table.to_markdown()
    assert "| trial 2 | **50.0** | 1 | optim.lr=2e-4 model.loss.ocsf_weight=5 |  |" in text
    assert "| trial 1 | – | 0 of 1 | optim.lr=1e-4 model.loss.ocsf_weight=5 | pruned at NDS 20.0 |" in text
    assert "failed: loss is nan (t.txt)" in text
    assert table.text[0] == "2 of 6 trials finished, 1 pruned, 1 failed."
    assert "The best one, trial 2, reaches NDS 50.0 with optim.lr=2e-4 model.loss.ocsf_weight=5." in text
    assert "optim.lr=2e-4" in table.to_csv() and "optim.lr=2e-4" in table.to_latex()


@pytest.mark.parametrize("name", sweep_files())
@pytest.mark.parametrize("scale", ["mini", "paper"])
def test_every_sweep_has_tables_before_and_after_it_ran(name, scale, make_result):
    sweep = load_sweep(name).at_scale(scale)
    rows = {row.label: {seed: f"{place}-{seed}" for seed in (0, 1)} for place, row in enumerate(sweep.rows)}
    runs = {
        run_id: RunState(run_id=run_id, overrides=[], seed=seed, label=label, state="done")
        for label, of in rows.items() for seed, run_id in of.items()
    }  # fmt: skip
    record = SweepRecord(
        sweep=sweep, scale=scale, command="", seeds=[0, 1], rows=rows, runs=runs, study="", storage=""
    )  # fmt: skip
    metrics = {metric: 0.1 + 0.01 * place for place, metric in enumerate(METRICS)}
    results = {run_id: make_result(run_id, metrics, run.seed, scale=scale) for run_id, run in runs.items()}
    for found in ({}, results):
        tables = sweep_tables(record, found)
        assert [table.name for table in tables] == [table.name for table in sweep.tables]
        for table in tables:
            trained = [row for row in table.rows if row.state != "paper"]
            assert all((row.state == "done") == bool(found) for row in trained)
            assert table.to_markdown() and table.to_csv() and table.to_latex()


def test_a_record_survives_json(make_record, results_of, tmp_path):
    """Seeds are numbers again after a record was written and read."""
    from src.report.sweep_record import read_record, record_path, write_record

    record = make_record({"a": {}, "b": {}}, baseline="b")
    write_record(record_path(tmp_path, "epsilon", "mini"), record)
    again = read_record(record_path(tmp_path, "epsilon", "mini"))
    results = results_of(THREE)
    assert sweep_tables(again, results) == sweep_tables(record, results)
    assert json.loads(record_path(tmp_path, "epsilon", "mini").read_text())["format"] == 1
