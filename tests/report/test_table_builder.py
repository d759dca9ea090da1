"""Tables of sweeps: numbers done by hand, rows without them, what is refused, and the three forms."""

import csv
import io
import json
import re

import pytest

from src.errors import ConfigError, DataError
from src.report.escaping import as_code, escape_latex, escape_markdown
from src.report.metric_names import METRICS
from src.report.results import read_results, result_path
from src.report.sweep_file import MAX_COLUMNS, DimensionConfig, SweepConfig
from src.report.sweep_record import RunState, SweepRecord
from src.report.table_builder import sweep_tables, write_sweep_tables
from src.sweep.sweep_files import load_sweep, sweep_files

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
    """Cells of the table by row label, *paper | here* as one."""
    lines = [line for line in markdown.splitlines() if line.startswith("| ")]
    found = [
        [re.sub(r"\\([|\[\]])", r"\1", cell.strip()) for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines
    ]
    return {cells[0]: cells[1:] for cells in found}


def with_bounds(results):
    """The results with an interval of 0.05 to each side of each score, over 20 scenes."""
    for result in results.values():
        result.scenes = 20
        result.intervals = {name: [value - 0.05, value + 0.05] for name, value in result.metrics.items()}
    return results


def test_means_intervals_and_differences_by_hand(make_record, results_of):
    record = make_record({"small": {"mAP": 18.6}, "large": {"mAP": 20.3}}, columns=("mAP", "mAVE"), baseline="large")
    (table,) = sweep_tables(record, with_bounds(results_of(THREE)))
    cell = table.rows[0].cells[0]
    assert cell.values == pytest.approx({0: 20.0, 1: 22.0, 2: 24.0}) and cell.bounds == pytest.approx((17.0, 27.0))
    text = cells_of(table.to_markdown())
    assert text["row: paper | here"] == ["mAP, %", "mAP to baseline", "mAVE, m/s", "mAVE to baseline"]
    # small minus large: -5, -4, -6; deviation 1, so 4.303 / sqrt(3) to each side
    small = ["18.6 | 22.0 [17.0, 27.0]", "-1.7 | -5.0 [-7.5, -2.5]", "0.78 [0.73, 0.83]", "+0.05 [+0.03, +0.07]"]
    assert text["small"] == small
    assert text["large"] == ["**20.3** | **27.0 [22.0, 32.0]**", "baseline", "**0.73 [0.68, 0.78]**", "baseline"]
    assert "In brackets 95 % intervals over the 20 validation scenes." in table.caption
    assert "Differences are to large, seed by seed, with Student's 95 % interval." in table.caption


def test_the_best_is_decided_against_every_other_row(make_record, results_of):
    record = make_record(dict.fromkeys("abc", {}), columns=("mAP",))
    near = {"c0": 0.27, "c1": 0.24, "c2": 0.30}  # against b +2, -2, 0
    (table,) = sweep_tables(record, results_of(THREE | near))
    assert not any(row.cells[0].best for row in table.rows)
    far = {"c0": 0.05, "c1": 0.04, "c2": 0.06}
    (table,) = sweep_tables(record, results_of(THREE | far))
    assert [row.cells[0].best for row in table.rows] == [False, True, False]


def test_one_seed_never_decides(make_record, results_of):
    record = make_record({"a": {"mAP": 18.0}, "b": {"mAP": 20.0}}, seeds=1, columns=("mAP",), baseline="b")
    (table,) = sweep_tables(record, results_of({"a0": 0.1, "b0": 0.9}))
    text = cells_of(table.to_markdown())
    assert text["a"] == ["18.0 | 10.0", "-2.0 | -80.0 undecided"] and text["b"][0] == "**20.0** | 90.0"
    assert table.text[1] == "mAP: the one ordering of two rows undecided: one seed never decides."


def test_results_without_intervals_still_have_a_table(make_record, results_of):
    (table,) = sweep_tables(make_record({"a": {}, "b": {}}), results_of(THREE))
    assert cells_of(table.to_markdown())["a"] == ["22.0", "44.0"] and "brackets" not in table.caption


def test_more_metrics_than_fit_are_the_lines(make_record, results_of):
    columns = ("mAP", "NDS", "mAVE", *(f"classes.{name}.AP" for name in ("car", "truck", "bus", "trailer", "animal")))
    record = make_record({"a": {"mAP": 9.0}, "b": {}}, columns=columns, baseline="b",
                         paper_rows={"other": {"NDS": 8.0}})  # fmt: skip
    (table,) = sweep_tables(record, results_of(THREE))
    text = cells_of(table.to_markdown())
    assert text["metric: paper | here"] == ["a", "b", "other"]
    assert text["mAP, %"] == ["9.0 | 22.0", "– | **27.0**", "– | –"]
    assert text["NDS, %"] == ["– | 44.0", "– | **54.0**", "8.0 | –"] and text["car AP, %"] == ["–", "–", "–"]
    assert "Differences" not in table.caption
    latex = table.to_latex()
    assert "\\begin{tabular}{lrrr}" in latex and "mAP, \\% & 9.0 \\textbar{} 22.0 &" in latex
    first, *_ = csv.DictReader(io.StringIO(table.to_csv()))
    assert first["mAP mean"] == "22.0", "for machines rows stay rows"


def test_a_table_that_fits_neither_way_is_refused(make_record):
    columns = tuple(list(METRICS)[:8])
    with pytest.raises(ConfigError, match="table_epsilon: 8 metrics of 8 rows fit no table of 8 columns"):
        make_record(dict.fromkeys("abcdefgh", {}), columns=columns)
    make_record(dict.fromkeys("abcdefg", {}), columns=columns)


def test_a_row_may_have_a_baseline_of_its_own(make_record, results_of):
    record = make_record({"a": {"mAP": 1.0}, "b": {"mAP": 3.0}, "c": {}, "d": {}}, seeds=1, columns=("mAP",))
    for row, baseline in zip(record.sweep.rows, "bbdd", strict=True):
        row.baseline = baseline
    (table,) = sweep_tables(record, results_of({"a0": 0.1, "b0": 0.2, "c0": 0.4, "d0": 0.1}))
    text = cells_of(table.to_markdown())
    differences = ["-2.0 | -10.0 undecided", "baseline", "– | +30.0 undecided", "baseline"]
    assert [text[label][1] for label in "abcd"] == differences
    assert table.baselines == ["b", "d"]
    assert "Differences are to b or d, seed by seed" in table.caption


def test_a_table_may_show_some_of_the_rows(make_record, results_of):
    record = make_record({"a": {"mAP": 9.0}, "b": {"mAP": 3.0}, "c": {}}, seeds=1, columns=("mAP",), baseline="b",
                         paper_rows={"other": {"mAP": 4.0}, "best": {"mAP": 8.0}})  # fmt: skip
    record.sweep.tables[0].rows = ["other", "c", "best"]
    results = results_of({"a0": 0.1, "b0": 0.2})
    results |= results_of({"c0": 0.4}, phase="phase2", epochs=1, commit="fedcba9876543210")
    (table,) = sweep_tables(record, results)
    assert "phase2: 1 epoch; seed 0; code fedcba9876; cpu" in table.caption and "phase1" not in table.caption
    text = cells_of(table.to_markdown())
    assert list(text) == ["row: paper | here", "other", "c", "best"]
    assert text["c"] == ["– | 40.0", "– | +20.0 undecided"]  # to the baseline that is not shown
    assert text["other"] == ["4.0 | –", "+1.0 | –"]
    assert text["best"][0] == "**8.0** | –"


def test_the_caption_names_what_was_run(make_record, results_of):
    results = results_of(THREE)
    results[f"{PREFIX}b2"].commit = "fedcba9876543210+"
    for seed in range(3):
        results[f"{PREFIX}b{seed}"].phase, results[f"{PREFIX}b{seed}"].epochs = "phase2", 1
    results[f"{PREFIX}a0"].latency = {"processor": "Fast CPU", "threads": 1, "ms": {}}
    (table,) = sweep_tables(make_record({"a": {}, "b": {}}), results)
    assert table.caption == (
        "Data: synthetic highway world, split val; scale mini; phase1: 6 epochs; phase2: 1 epoch; seeds 0, 1, 2, of "
        "which means; code 0123456789, fedcba9876+; cpu, 1 process of 2 threads. Bold is decided against every other "
        "row."
    )
    (table,) = sweep_tables(make_record({"a": {}, "b": {}}, columns=("mAP", "latency.total")), results)
    assert table.caption.endswith("every other row. Latency on Fast CPU, 1 thread.")


def test_the_caption_says_in_what_processors_multiplied_that_need_not_have_bfloat16(make_record, results_of):
    results = results_of(THREE)
    precisions = {"a": "bf16-products", "b": "32-true"}
    for run_id, result in results.items():
        result.config = {"precision": precisions[run_id.removeprefix(PREFIX)[0]]}
        result.cpu_products = {"float32": "torch", "bfloat16": "never"}
    results[f"{PREFIX}a1"].cpu_products = {"float32": "torch", "bfloat16": "from 256 rows"}
    results[f"{PREFIX}a2"].cpu_products = None
    (table,) = sweep_tables(make_record({"a": {}, "b": {}}), results)
    where = "cpu, 1 process of 2 threads"
    products = f"{where} (matrix products in bfloat16), {where} (matrix products in float32)"
    assert f"; {where}, {products}. Bold" in table.caption


def test_a_note_stands_under_every_table_whatever_has_run(make_record, results_of):
    record = make_record({"a": {}, "b": {}})
    record.sweep.note = "Half of the *rate* for a"
    for results in (results_of(THREE), {}):
        (table,) = sweep_tables(record, results)
        assert table.text[0] == record.sweep.note and len(table.text) > 1
        assert "Half of the \\*rate\\* for a" in table.to_markdown() and "Half of the *rate* for a" in table.to_latex()


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
    assert text["a (1 of 2 seeds; failed: loss is nan (logs/a1.txt), seed 1)"] == ["20.0 | 30.0"]
    assert text["b (0 of 2 seeds; failed: no | memory (logs/b0.txt), seed 0; running)"] == ["20.0 | –"]
    assert {"c (0 of 2 seeds; running; not run yet)", "d (0 of 2 seeds; not run yet)"} < set(text)
    assert f"e (1 of 2 seeds; result missing or not readable: results/{PREFIX}e1.json, seed 1)" in text
    assert [row.state for row in table.rows] == ["failed", "failed", "running", "waiting", "failed"]
    assert not any(cell.best for row in table.rows for cell in row.cells)  # no row is whole
    assert "Bold is decided against every other row whose seeds have all finished." in table.caption


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
    assert text["d (0 of 1 seed; waiting; the number is of an earlier training)"] == ["40.0 (n = 1)"]
    assert "**" not in table.to_markdown()


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


@pytest.mark.parametrize(
    ("part", "key", "before", "other"), [("data", "train_scenes", None, 4), ("model", "doppler", {"withheld": 0.0}, {})]
)
def test_a_key_that_one_run_lacks_is_the_same_at_its_value_of_before(make_record, results_of, part, key, before, other):
    """The newer run has a younger key, the older one a key that has gone."""
    lacking = results_of({"a0": 0.1}, config={"seed": 0, part: {key: {}} if isinstance(before, dict) else {}})
    for value, same in ((before, True), (other or {"withheld": 0.5}, False)):
        results = lacking | results_of({"a1": 0.2}, config={"seed": 1, part: {key: value}})
        if same:
            assert sweep_tables(make_record({"a": {}}, seeds=2), results)[0].rows[0].done == 2
        else:
            with pytest.raises(DataError, match="differ in more than their seed"):
                sweep_tables(make_record({"a": {}}, seeds=2), results)


def test_weights_that_a_row_begins_with_are_of_its_seeds(make_record, results_of):
    """Their runs have ids of their own, given or found by the phase's name; another phase is another configuration."""

    def row_of(*sources):
        results = {}
        for seed, source in enumerate(sources):
            config = {"seed": seed, "phase": {"init_from": source, "epochs": 0}}
            results |= results_of({f"a{seed}": 0.1}, config=config)
        return sweep_tables(make_record({"a": {}}, seeds=2), results)[0].rows[0]

    assert row_of("horizon3d-phase1-mini-0123abcd", "horizon3d-phase1-mini-4567cdef").done == 2
    assert row_of("phase1", "horizon3d-phase1-mini-4567cdef").done == 2
    for other in (None, "phase2", "horizon3d-phase2-mini-0123abcd", "/x/other.ckpt"):
        with pytest.raises(DataError, match="row a: .* differ in more than their seed"):
            row_of(other, "horizon3d-phase1-mini-4567cdef")


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
    assert text["a"] == ["250.0 ± 10.0", "4.00 ± 0.16"] and text["b"][0] == "**200.0 ± 20.0**"
    assert "half the range of the middle half of its frames" in table.caption
    assert "Latency on CPU, 1 thread, measured on a busy machine" in table.caption
    timed(results[f"{PREFIX}b0"], 225.0, 40.0, load=1.0, cores=4)  # 25 apart, within 10 + 20
    (table,) = sweep_tables(record, results)
    assert not any(cell.best for row in table.rows for cell in row.cells) and "busy" not in table.caption


def test_latencies_of_different_machines_are_not_compared(make_record, results_of):
    record = make_record({"a": {}, "b": {}}, seeds=1, columns=("latency.total",), baseline="a")
    results = results_of({"a0": 0.1, "b0": 0.1})
    timed(results[f"{PREFIX}a0"], 250.0, 4.0)
    for changes, compared in (({}, True), ({"threads": 2}, False), ({"processor": "another CPU"}, False)):
        timed(results[f"{PREFIX}b0"], 100.0, 4.0, **changes)
        (table,) = sweep_tables(record, results)
        assert [row.cells[0].best for row in table.rows] == [False, compared]
        assert (table.rows[1].cells[0].comparison is not None) == compared


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
    assert text["BEVFusion"] == ["18.2 | –", "4.20 | –"]
    assert text["ours"] == ["**23.6** | 30.0", "– | –"]  # never measured: a dash
    assert table.text[1] == "One row is trained here, so there is nothing to compare it with."
    record.sweep.baseline = "ours"
    assert cells_of(sweep_tables(record, results_of({"a0": 0.3}))[0].to_markdown()) == text  # no empty columns


def test_latency_of_fewer_runs_says_of_how_many(make_record, results_of):
    results = results_of({"a0": 0.3, "a1": 0.3})
    results[f"{PREFIX}a1"].metrics["latency.total"] = 117.7
    (table,) = sweep_tables(make_record({"a": {}}, seeds=2, columns=("latency.total",)), results)
    assert cells_of(table.to_markdown())["a"][0] == "117.7 (n = 1)"


def test_differences_say_over_how_many_seeds(make_record, results_of):
    states = {"b1": {"state": "waiting"}, "b2": {"state": "waiting"}}
    record = make_record({"a": {}, "b": {}}, columns=("mAP",), baseline="b", states=states)
    (table,) = sweep_tables(record, results_of({"a0": 0.2, "a1": 0.3, "a2": 0.4, "b0": 0.1}))
    assert table.rows[0].cells[0].comparison.mean == pytest.approx(10.0)
    assert "+10.0 undecided (n = 1)" in table.to_markdown()


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


@pytest.mark.parametrize(
    ("baselines", "digests", "apart"),
    [
        ((None, None, None), "122", "a0"),  # each two rows are compared
        (("b", "b", "b"), "122", "a0"),
        (("b", "b", None), "112", ""),  # c is compared with none
        (("b", "b", "b"), "121", "a0, c0"),
        (("b", "b", "b"), "111", ""),
        (("b", "b", "b"), "0x1", ""),  # what is not recorded may be the same
    ],
)
def test_a_table_says_which_runs_begin_from_another_training_than_what_they_are_compared_with(
    make_record, results_of, baselines, digests, apart
):
    record, results = make_record({"a": {}, "b": {}, "c": {}}, seeds=1), {}
    for row, baseline, digest in zip(record.sweep.rows, baselines, digests, strict=True):
        row.baseline = baseline
        start = {"initialized_from": f"{PREFIX}0", "initial_weights": None if digest == "x" else digest * 16}
        results |= results_of({f"{row.label}0": 0.1}, **start)
    text = sweep_tables(record, results)[0].to_markdown()
    assert ("another training" in text) == bool(apart)
    named = ", ".join(f"{PREFIX}{end}" for end in apart.split(", "))
    assert not apart or f"whose noise is in those differences and intervals: {named}." in text


def test_weights_scored_once_more_are_those_of_their_row(make_record, results_of):
    record = make_record({"a": {}, "b": {}}, seeds=1)
    trained = results_of({"a0": 0.1}, weights="1" * 16)
    again = {"initialized_from": f"{PREFIX}a0", "weights": "3" * 16}
    for digest, is_other in (("1" * 16, False), ("2" * 16, True)):
        (table,) = sweep_tables(record, trained | results_of({"b0": 0.2}, **again, initial_weights=digest))
        assert ("another training" in table.to_markdown()) == is_other


def test_results_of_another_scale_alone_are_refused(make_record, results_of):
    with pytest.raises(DataError, match="sweep epsilon, scale mini: .*scale debug"):
        sweep_tables(make_record({"a": {}}, seeds=1), results_of({"a0": 0.1}, scale="debug"))


def test_orderings_of_the_paper_in_a_sentence(make_record, results_of):
    record = make_record({"a": {"mAP": 18.0}, "b": {"mAP": 20.0}, "c": {"mAP": 19.0}}, columns=("mAP",), baseline="b")
    (table,) = sweep_tables(record, results_of(THREE | {"c0": 0.26, "c1": 0.27, "c2": 0.29}))
    frame, found = table.text
    assert "synthetic highway" in frame and "neither results on TruckScenes" in frame
    # b minus a: 5, 4, 6; c minus a: 6, 5, 5; b minus c: -1, -1, 1
    assert found == "mAP: 2 of 3 orderings of two rows hold here (b before a, c before a), 1 undecided."
    turned = {"c0": 0.35, "c1": 0.36, "c2": 0.40}
    (table,) = sweep_tables(record, results_of(THREE | turned))
    assert table.text[1] == (
        "mAP: 2 of 3 orderings of two rows hold here (b before a, c before a), 1 the other way round (b before c)."
    )
    assert table.text[1] in table.to_markdown()


def test_less_is_better_turns_the_orderings_round(make_record, results_of):
    record = make_record({"a": {"mAVE": 0.6}, "b": {"mAVE": 0.9}}, columns=("mAVE",))
    (table,) = sweep_tables(
        record, results_of({f"b{seed}": 0.3 for seed in range(3)} | {"a0": 0.5, "a1": 0.5, "a2": 0.51})
    )
    assert table.text[1] == "Over all metrics: 1 of 1 ordering of two rows holds here (a before b)."


def test_a_table_without_main_metrics_is_judged_over_all(make_record, results_of):
    record = make_record({"a": {"mAVE": 0.6, "classes.car.AP": 1.0}, "b": {"mAVE": 0.9, "classes.car.AP": 2.0}},
                         columns=("mAVE", "classes.car.AP"))  # fmt: skip
    results = results_of({f"b{seed}": 0.3 for seed in range(3)} | {"a0": 0.5, "a1": 0.5, "a2": 0.51})
    for seed in range(3):
        for label in "ab":
            results[f"{PREFIX}{label}{seed}"].metrics["classes.car.AP"] = 0.5
    (table,) = sweep_tables(record, results)
    assert table.text[1] == ("Over all metrics: 1 of 2 orderings of two rows holds here (mAVE: a before b); 1 equal.")


def test_rows_that_agree_in_every_pair_are_equal(make_record, results_of):
    record = make_record({"a": {}, "b": {}}, columns=("mAP",), baseline="b")
    (table,) = sweep_tables(
        record, results_of({f"{label}{seed}": 0.1 * (seed + 1) for label in "ab" for seed in range(3)})
    )
    assert table.text[1] == "mAP: the one comparison equal."


def test_rows_that_the_paper_does_not_have_are_held_against_their_baseline(make_record, results_of):
    record = make_record({"a": {}, "b": {}, "c": {}}, columns=("mAP",), baseline="b")
    (table,) = sweep_tables(record, results_of(THREE | {"c0": 0.26, "c1": 0.25, "c2": 0.30}))
    frame, found = table.text
    assert "the paper has no numbers for these rows" in frame
    assert found == "mAP: a worse than b, 1 undecided."


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
    assert "\\begin{tabular}{lrr}" in latex and "\\toprule" in latex and "& mAP, \\% &" in latex
    body = latex.split("\\midrule")[1].split("\\bottomrule")[0].strip().splitlines()
    assert [len(re.split(r"(?<!\\)&", line)) for line in body] == [3, 3]
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
    assert (a["mAP paper"], a["mAP mean"], a["mAP low"], a["mAP n"]) == ("18.6", "22.0", "", "3")
    assert (a["mAP diff"], a["mAP diff n"], a["mAP paper diff"]) == ("-5.0", "3", "-1.7")
    assert float(a["mAP diff low"]) == pytest.approx(-7.484, abs=1e-3) and float(a["mAP diff high"]) < 0
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
    assert "| a (1 seed) | 10.0 |" in text and "result missing or not readable" in text
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
    assert "| trial | NDS, % | chosen |" in text
    assert "| trial 2 | 50.0 | optim.lr=2e-4 model.loss.ocsf_weight=5 |" in text
    assert "| trial 1 (pruned at NDS 20.0) | – | optim.lr=1e-4 model.loss.ocsf_weight=5 |" in text
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
            assert table.to_csv()
            header = table.to_markdown().splitlines()[2]
            columns = len(re.split(r"(?<!\\)\|", header)) - 2
            assert columns == 1 + len(table.heads) <= MAX_COLUMNS, header
            assert len(re.search(r"begin{tabular}{(l+r+)}", table.to_latex())[1]) == columns
            assert all(len(cells) == columns - 1 for _, cells in table.lines)


def test_a_record_survives_json(make_record, results_of, tmp_path):
    """Seeds are numbers again after a record was written and read."""
    from src.report.sweep_record import read_record, record_path, write_record

    record = make_record({"a": {}, "b": {}}, baseline="b")
    write_record(record_path(tmp_path, "epsilon", "mini"), record)
    again = read_record(record_path(tmp_path, "epsilon", "mini"))
    results = results_of(THREE)
    assert sweep_tables(again, results) == sweep_tables(record, results)
    assert json.loads(record_path(tmp_path, "epsilon", "mini").read_text())["format"] == 1
