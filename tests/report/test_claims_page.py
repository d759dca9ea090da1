"""The page of the claims and its picture, through the command's own entry."""

import json
from dataclasses import replace

import pytest
from PIL import Image

from src.dashboard import single_file as export
from src.errors import DataError
from src.report import __main__ as page
from src.report.sweep_record import record_path, write_record
from src.report.sweep_text import describe_starts
from src.sweep.sweep_files import load_sweep


@pytest.fixture
def report(tmp_path, monkeypatch, capsys):
    """Writes all pages of the runs under `tmp_path`; returns the folder and what was printed."""
    monkeypatch.setattr(export, "export_dashboard", lambda *arguments: None)

    def run(scale="mini"):
        reports = tmp_path / "reports"
        page.main(["phase=phase1", f"scale={scale}", f"paths.outputs={tmp_path}", f"paths.reports={reports}"])
        return reports, capsys.readouterr().out

    return run


@pytest.fixture
def write_sweep(write_run, make_record, tmp_path, monkeypatch):
    """Writes the record of a sweep and a run for each row and seed; every score is the row's value for that seed.

    The sweep's file defines its rows as the record does.
    """
    filed = {}
    monkeypatch.setattr(page, "load_sweep", lambda name: filed.get(name) or load_sweep(name))

    def write(name, rows, changes=(), scale="mini", overrides=(), latency=False, states=None, weights=None):
        record = make_record(
            dict.fromkeys(rows, {}), seeds=max(map(len, rows.values())), name=name, scale=scale, states=states
        )
        record.changes, record.sweep.overrides = list(changes), list(overrides)
        record.sweep.latency = latency
        for row in record.sweep.rows:
            row.weights = (weights or {}).get(row.label)
        own = [replace(row, overrides=[f"x={row.label}"], scale_overrides={}) for row in load_sweep(name).rows]
        filed[name] = replace(load_sweep(name), overrides=list(overrides), scale_overrides={}, rows=own)
        for label, values in rows.items():
            for seed, value in enumerate(values):
                end = record.rows[label][seed].rpartition("-")[2]
                write_run(end, [f"x={label}"], seed, value, speeds=True, scale=scale)
        write_record(record_path(tmp_path / "reports", name, scale, changes), record)

    return write


def test_claims_with_results_stand_beside_those_that_are_not_run(report, write_sweep):
    write_sweep("enlargement", {"off": [0.10, 0.10, 0.10], "on, 4.8 m": [0.12, 0.121, 0.119]})
    reports, said = report()
    text = (reports / "README.md").read_text()
    assert f"written: {reports / 'README.md'}" in said and len(text.splitlines()) < 70
    assert "Of 10 claims: undecided 1, not run 9." in text  # claim 3 wants the optimum as well
    command = "`python -m src.sweep +sweep=enlargement scale=mini seeds=3`"
    # deviation 0.1, so 7.6488 * 0.1 / sqrt(3) = 0.44 to each side
    assert f"| on, 4.8 m over off | mAP, % | +3.1 | +2.0 [+1.6, +2.4] | 3 | shows | {command} |" in text
    missing = "`python -m src.sweep +sweep=layers scale=mini seeds=3`"
    assert f"| 2 layers over 1 layer | mAP, % | +1.1 | – | – | not run | {missing} |" in text
    assert "|  | *mAP, %* | +1.4 | – | – |  |  |" in text
    assert "Data: synthetic highway world, split val; scale mini; 6 runs of up to 3 seeds; phase1: 6 epochs" in text
    assert "code 0123456789" in text and "(pictures/claims_mini.png)" in text
    assert Image.open(reports / "pictures" / "claims_mini.png").width == 1600


def test_runs_are_named_that_began_from_other_weights_than_those_they_are_compared_with(make_result):
    """Two pairs of one source, each of one training of it, and a third of two."""

    def run(name, weights):
        return make_result(name, {}, initialized_from="phase1", initial_weights=weights)

    pairs = [(run("a", "x"), run("b", "x")), (run("c", "y"), run("d", "y"))]
    assert describe_starts(pairs) == ""
    assert describe_starts([*pairs, (run("e", "x"), run("f", "y"))]).endswith("differences and intervals: e.")
    unknown = [(run("e", "x"), run("f", None)), (run("g", None), run("h", None))]
    told = "Of 2 such pairs it is not recorded whether both began from one training."
    assert describe_starts([*unknown, unknown[0]]) == told, "a pair that several measures compare is one"
    assert describe_starts([(make_result("i", {}), make_result("j", {}))]) == "", "both began from fresh weights"


def test_what_tells_why_stands_behind_the_claims_as_far_as_it_has_run(report, write_sweep, caplog):
    values = [0.12, 0.121, 0.119]
    write_sweep("comparison", {"Horizon3D, neck (ours)": values, "BEVFusion": [0.10] * 3})
    reports, said = report()
    text = (reports / "README.md").read_text()
    found = "%: +2.0 [+1.6, +2.4], 3 seeds"
    answer = f"mAP, {found}; mAP 0-25 m, {found}; mAP 50-100 m, {found}"
    why = (reports / "claims_why_mini.md").read_text()
    claims, words = text.split("## Why")
    command = "`python -m src.sweep +sweep=comparison scale=mini seeds=3`"
    row = "| 10 | Is it ahead with a head that sees more than 3 x 3 cells? | Horizon3D, neck (ours) over BEVFusion"
    assert f"{row} | {answer} | {command} |" in why and "neck" not in claims
    assert (
        "Of 10 claims: not run 10." in text and "| 10 | On which classes? | Horizon3D over BEVFusion | not run |" in why
    )
    assert why.count("\n| 10 |") == 3 and why.count("\n| ") == 4
    assert f"written: {reports / 'claims_why_mini.md'}" in said and "](claims_why_mini.md)" in words
    assert "* **" not in words and "claim lead: because speaks of the verdict 'does not show'" in caplog.text


@pytest.mark.parametrize("settings", [[], ["optim.rise_fraction=0.4", "model.kggi.num_radar_keypoints=256"]])
def test_the_page_says_which_sweeps_have_settings_of_their_own(report, write_sweep, settings):
    write_sweep("layers", {"1 layer": [0.1] * 3, "2 layers": [0.2] * 3}, overrides=["phase=phase1", *settings])
    text = (report()[0] / "README.md").read_text()
    assert ("settings of their own" in text) == bool(settings)
    assert not settings or "\n- `layers`: `optim.rise_fraction=0.4 model.kggi.num_radar_keypoints=256`\n" in text


def test_a_row_that_its_file_defines_otherwise_by_now_has_not_run(report, write_sweep):
    write_sweep("paths", {"phase 1 continued": [0.1] * 3, "BEV path": [0.2] * 3, "Gaussian path": [0.2] * 3})
    (row,) = (row for row in page.load_sweep("paths").rows if row.label == "BEV path")
    row.overrides = ["x=another"]
    text = (report()[0] / "README.md").read_text()
    assert "| BEV path over phase 1 continued | mAP, % | – | – | – | not run |" in text
    assert "| Gaussian path over phase 1 continued | mAP, % | – | +10.0 [+10.0, +10.0] | 3 | shows |" in text


def test_the_command_trains_all_seeds_that_the_page_reads(report, write_sweep):
    write_sweep("layers", {"1 layer": [0.10] * 7, "2 layers": [0.10, 0.12, 0.14, 0.10, 0.12, 0.14, 0.9]})
    text = (report()[0] / "README.md").read_text()
    # 0, 2, 4 twice: deviation sqrt(16 / 5), so 3.5341 * sqrt(3.2 / 6) = 2.58 to each side; the seventh is no look
    row = "| 2 layers over 1 layer | mAP, % | +1.1 | +2.0 [-0.6, +4.6] | 6 | undecided |"
    assert f"{row} `python -m src.sweep +sweep=layers scale=mini seeds=6` |" in text


def test_without_a_result_of_any_claim_there_is_no_page(report, write_sweep):
    write_sweep("layers", {"1 layer": [0.10], "2 layers": [0.2]}, changes=["phase.epochs=1"])
    reports, said = report()
    assert "README" not in said and not (reports / "README.md").exists()


def test_a_damaged_result_leaves_the_page_as_it_was(report, write_sweep, tmp_path):
    write_sweep("layers", {"1 layer": [0.10] * 3, "2 layers": [0.20, 0.21, 0.19]})
    path = report()[0] / "README.md"
    before = path.read_text()
    first, *_ = sorted((tmp_path / "reports" / "results").iterdir())
    first.write_text("{")
    (tmp_path / first.stem / "run.json").unlink()  # or it would be written anew
    with pytest.raises(
        DataError, match=rf"all else is written, but\n.*{first.name}.*\n.*page of the claims is as it was"
    ):
        report()
    assert path.read_text() == before and "2 layers over 1 layer" in before


def test_another_scale_has_a_page_of_its_own(report, write_sweep):
    rows = {"1 layer": [0.2] * 3, "2 layers": [0.1] * 3}
    write_sweep("layers", rows)
    write_sweep("layers", rows, scale="debug")
    default = (report()[0] / "README.md").read_text()
    reports, _ = report("debug")
    assert (reports / "README.md").read_text() == default
    debug = (reports / "claims_debug.md").read_text()
    assert "# The paper's claims, scale debug" in debug and "](claims_why_debug.md)" in debug
    assert default.count("\n* **") == default.count("\n* **4** ") == 1, "of claims whose verdict is that of the words"
    assert "\n* **" not in debug, "the words are of the default scale"


@pytest.mark.parametrize("latency", [True, False])
def test_rows_of_a_sweep_that_times_them_become_a_picture(report, write_sweep, tmp_path, latency):
    """One timed row alone is no picture, nor are rows that another sweep timed."""
    write_sweep("layers", {"1 layer": [0.10], "2 layers": [0.12], "4 layers": [0.11]}, latency=latency)
    folders = sorted(path.parent for path in tmp_path.glob("*/run.json"))
    picture = tmp_path / "reports" / "pictures" / "layers_latency_mini.png"
    for folder, enough in zip(folders[:2], (False, True), strict=True):
        timed = {"ms": {"total": 250.0}, "spread_ms": {"total": 20.0}, "fps": 4.0, "memory_gb": 1.0}
        (folder / "latency.json").write_text(json.dumps(timed))
        _, said = report()
        assert picture.is_file() == (f"written: {picture}" in said) == (enough and latency)
    assert not latency or Image.open(picture).width == 1600


def test_the_picture_shows_what_a_table_compares(report, write_sweep, tmp_path, monkeypatch):
    """Rows that the same machine timed, by results of their last training; fewer seeds are named.

    Weights that two rows score are one method.
    """
    rows = {"one": [0.10, 0.11], "few": [0.20, 0.21], "again": [0.30, 0.31], "elsewhere": [0.40, 0.41]}
    rows["other rule"] = [0.50, 0.51]
    states = {"b1": {"state": "running"}, "c0": {"state": "waiting"}, "c1": {"state": "waiting"}}
    write_sweep("layers", rows, latency=True, states=states, weights={"other rule": "one"})
    for end in "abcde":
        timed = {"ms": {"total": 250.0}, "spread_ms": {"total": 20.0}, "fps": 4.0, "memory_gb": 1.0,
                 "processor": "another CPU" if end == "d" else "CPU"}  # fmt: skip
        (tmp_path / f"horizon3d-phase1-mini-{end}0" / "latency.json").write_text(json.dumps(timed))
    drawn = []
    monkeypatch.setattr(page, "draw_trade_off", lambda path, points, title, cost, score: drawn.append((points, cost)))
    report()
    ((points, cost),) = drawn
    assert [(point.label, point.score) for point in points] == [("one", pytest.approx(10.5)), ("few, 1 seed", 20.0)]
    assert cost == "milliseconds from frame to boxes, CPU, 1 thread"
