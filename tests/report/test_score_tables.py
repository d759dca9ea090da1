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
    gain_table,
    group_runs,
    mean_and_spread,
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


def test_seeds_are_averaged_and_the_best_is_bold(read, write_run):
    for seed, value in enumerate((0.3, 0.4, 0.5)):
        write_run(f"a{seed}", [f"seed={seed}", "phase=phase1"], seed, value)
    write_run("b", ["model.kggi=null", "model.ocsf=null", "paths.outputs=x", "data.root=y"], 0, 0.1)
    write_run("c", [], 0, 0.9, scale="debug")
    names = {(): "ours", ("model.kggi=null", "model.ocsf=null"): "radar only"}
    experiments = group_runs(read(), lambda run: names[run.settings])
    lines = score_table(experiments, SUMMARY).splitlines()
    assert lines[0].startswith("| experiment | mAP | NDS | car AP | mAP 0-25 m")
    assert lines[2].startswith("| ours | **40.0 ± 10.0** |")
    assert lines[3].startswith("| radar only | 10.0 |")
    assert class_table(experiments).splitlines()[0] == "| experiment | car | truck |"
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
    assert rows["| `x=1`"] == "| `x=1` |" + " - |" * 8
    assert rows["| `y=1`"] == "| `y=1` |" + " - |" * 8
    assert rows["| `defaults`"] == "| `defaults` |" + " **20.0** |" * 4 + " **1.80** |" * 4


def test_the_smaller_error_is_the_better(read, write_run):
    write_run("a", ["x=1"], 0, 0.3, speeds=True)
    write_run("b", [], 0, 0.2, speeds=True)
    table = score_table(group_runs(read(), unnamed), ERROR_BY_SPEED)
    assert "| `x=1` | **1.70** |" in table and "| `defaults` | 1.80 |" in table


def test_gains_are_paired_by_seed(read, write_run):
    for seed, (before, after) in enumerate([(0.10, 0.15), (0.30, 0.37), (0.50, 0.54)]):
        write_run(f"a{seed}", [], seed, before)
        write_run(f"b{seed}", ["x=1"], seed, after, speeds=True)
    write_run("b7", ["x=1"], 7, 0.9)  # no partner
    write_run("c", ["y=1"], 9, 0.1)
    better, plain, lone = group_runs(read(), unnamed)
    lines = gain_table(better, [plain, lone], [METRICS["mAP"], BY_SPEED[0]]).splitlines()
    assert lines[0] == "| `x=1` over | seeds | mAP | mAP 0-0.5 m/s |"
    assert lines[2] == "| `defaults` | 3 | +5.3 ± 1.5 | - |"  # 5, 7, 4: far less than the spread over seeds
    assert lines[3] == "| `y=1` | 0 | - | - |"
    assert "| 3 | -5.3 ± 1.5 |" in gain_table(plain, [better], [METRICS["mAP"]])


def test_spread_of_one_and_of_none():
    assert mean_and_spread([], METRICS["mAVE"]) is None
    assert mean_and_spread([0.5], METRICS["mAVE"]) == (0.5, 0.0)
    assert mean_and_spread([0.2, 0.4], METRICS["mAP"]) == (pytest.approx(30), pytest.approx(14.1421, abs=1e-4))


def test_settings_cannot_break_a_table(read, write_run):
    write_run("a", ["x=`1|2`"], 0, 0.3)
    assert score_table(group_runs(read(), unnamed), SUMMARY[:1]).splitlines()[2] == "| `x='1\\|2'` | 30.0 |"
