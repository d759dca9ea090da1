"""Tables of experiments: means over seeds, what is best, what is missing, gains seed by seed."""

import pytest

from src.report.metric_names import METRICS
from src.report.results import read_results
from src.report.score_tables import (
    BY_SPEED,
    ERROR_BY_SPEED,
    SUMMARY,
    class_table,
    cost_table,
    estimate,
    gain_table,
    group_runs,
    score_table,
)


def unnamed(run):
    return None


@pytest.fixture
def read(tmp_path, publish_all):
    """Publishes every run written so far and reads those of scale mini."""

    def run():
        publish_all()
        return list(read_results(tmp_path / "reports", "mini")[0].values())

    return run


def test_seeds_are_averaged(read, write_run):
    for seed, value in enumerate((0.3, 0.4, 0.5)):
        write_run(f"a{seed}", [f"seed={seed}", "phase=phase1"], seed, value)
    write_run("b", ["model.kggi=null", "model.ocsf=null", "paths.outputs=x", "data.root=y"], 0, 0.1)
    write_run("c", [], 0, 0.9, scale="debug")
    names = {(): "ours", ("model.kggi=null", "model.ocsf=null"): "radar only"}
    experiments = group_runs(read(), lambda run: names[run.settings])
    lines = score_table(experiments, SUMMARY).splitlines()
    assert lines[0] == "| experiment | mAP, % | NDS, % | mAVE, m/s | car AP, % |"  # moving vehicles nobody has
    assert lines[2].startswith("| ours | 40.0 |"), "one seed in common decides nothing"
    assert lines[3].startswith("| radar only | 10.0 |")
    assert class_table(experiments).splitlines()[0] == "| experiment | car, % | truck, % |"
    assert "| ours | 0, 1, 2 | 2.50 M | 12 | 900 |" in cost_table(experiments)
    assert "| ours | 0, 1, 2 | 6 | 2.50 M | 12 | 900 |" in cost_table(experiments, epochs=True)


def test_different_data_never_share_a_table(read, write_run):
    write_run("a", [], 0, 0.3)
    write_run("b", [], 1, 0.3, root="other")
    with pytest.raises(ValueError, match="never mixes data"):
        group_runs(read(), unnamed)


def test_experiments_of_one_name_show_their_settings(read, write_run):
    write_run("a", ["phase.epochs=2"], 0, 0.3)
    write_run("b", ["phase.epochs=3"], 0, 0.4)
    experiments = group_runs(read(), lambda run: "more")
    assert [e.label for e in experiments] == ["more (`phase.epochs=3`)", "more (`phase.epochs=2`)"]


def test_what_a_run_was_not_scored_by_is_a_dash(read, write_run):
    write_run("a", ["x=1"], 0, 0.3)
    write_run("b", [], 0, 0.2, speeds=True)
    write_run("c", ["y=1"], 0, 0.1, speeds=True)
    write_run("d", ["y=1"], 1, 0.9)  # the mean of the other seed alone would not compare
    experiments = group_runs(read(), unnamed)
    rows = {line.split(" | ")[0]: line for line in score_table(experiments, BY_SPEED + ERROR_BY_SPEED).splitlines()}
    # Eight columns and the labels are cut in two.
    assert rows["| `x=1`"] == "| `x=1` |" + " – |" * 4 and rows["| `y=1`"] == "| `y=1` |" + " – |" * 4
    assert rows["| `defaults`"] == "| `defaults` |" + " 1.80 |" * 4
    assert score_table(experiments[:1], BY_SPEED) == "", "what no run has is left out"


def test_bold_is_decided_against_every_other_row(read, write_run):
    for seed in range(3):
        write_run(f"a{seed}", ["x=1"], seed, 0.30 + 0.01 * seed)
        write_run(f"b{seed}", [], seed, 0.20 + 0.012 * seed)
    experiments = group_runs(read(), unnamed)
    lines = score_table(experiments, [METRICS["mAP"], METRICS["mAVE"]]).splitlines()
    assert lines[2:] == ["| `x=1` | **31.0** | **1.69** |", "| `defaults` | 21.2 | 1.79 |"]
    for seed in range(3):
        write_run(f"c{seed}", ["y=1"], seed, 0.30 + 0.02 * seed)  # 0, -1, -2 to the best
    assert "**" not in score_table(group_runs(read(), unnamed), [METRICS["mAP"]])


def test_gains_are_paired_by_seed(read, write_run):
    for seed, (before, after) in enumerate([(0.10, 0.15), (0.30, 0.37), (0.50, 0.54)]):
        write_run(f"a{seed}", [], seed, before)
        write_run(f"b{seed}", ["x=1"], seed, after, speeds=True)
    write_run("b7", ["x=1"], 7, 0.9, speeds=True)  # no partner
    write_run("c", ["y=1"], 9, 0.1)
    better, plain, lone = group_runs(read(), unnamed)
    lines = gain_table(better, [plain, lone], [METRICS["mAP"], BY_SPEED[0], METRICS["measures.moving_AP"]]).splitlines()
    assert lines[0] == "| `x=1` over | seeds | mAP, % | mAP 0-0.5 m/s, % |"
    assert lines[2] == "| `defaults` | 3 | +5.3 [+1.5, +9.1] | – |"  # 5, 7, 4: far less than the spread over seeds
    assert lines[3] == "| `y=1` | 0 | – | – |"
    assert "| 3 | -5.3 [-9.1, -1.5] |" in gain_table(plain, [better], [METRICS["mAP"]])
    assert gain_table(plain, [better], BY_SPEED) == ""


def test_estimates_of_one_and_of_none(make_result):
    runs = [make_result("a", {"mAP": 0.2}), make_result("b", {"mAP": 0.4}, 1)]
    assert estimate([], METRICS["mAVE"]) is None and estimate(runs, METRICS["mAVE"]) is None
    assert estimate(runs, METRICS["mAP"]) == pytest.approx((30, 30, 30))
    runs[0].intervals["mAP"] = [0.1, 0.3]
    assert estimate(runs, METRICS["mAP"]) == pytest.approx((30, 30, 30)), "the other run has no interval"
    runs[1].intervals["mAP"] = [0.3, 0.6]
    assert estimate(runs, METRICS["mAP"]) == pytest.approx((30, 20, 45))
    experiments = group_runs(runs, unnamed)
    assert score_table(experiments, SUMMARY[:1]).splitlines()[2] == "| `defaults` | 30.0 [20.0, 45.0] |"


def test_settings_cannot_break_a_table(read, write_run):
    write_run("a", ["x=`1|2`"], 0, 0.3)
    assert score_table(group_runs(read(), unnamed), SUMMARY[:1]).splitlines()[2] == "| `x='1\\|2'` | 30.0 |"
