"""Which runs stand on which page and what they are called, through the command's own entry."""

import copy
import json
from dataclasses import replace

import pytest
from PIL import Image

from src.config import compose_config
from src.dashboard import single_file as export
from src.errors import DataError
from src.report.__main__ import main, write_pages
from src.report.pages import changed_since, runs_on_page, without_defaults
from src.report.results import publish_result, read_result, result_path
from src.report.sweep_record import record_path, write_record

NO_VELOCITY = [
    "model.dptf.gaussian_path.velocity_compensation=false",
    "model.dptf.bev_path.velocity_compensation=false",
]


@pytest.fixture
def exported(monkeypatch):
    """What the dashboard was exported from, call by call; it has tests of its own."""
    calls = []
    monkeypatch.setattr(export, "export_dashboard", lambda *arguments: calls.append(arguments))
    return calls


@pytest.fixture
def report(tmp_path, capsys, exported):
    def run(phase, scale="mini"):
        main([f"phase={phase}", f"scale={scale}", f"paths.outputs={tmp_path}", f"paths.reports={tmp_path / 'reports'}"])
        assert f"{phase}_{scale}.md" in capsys.readouterr().out
        return (tmp_path / "reports" / f"{phase}_{scale}.md").read_text()

    return run


@pytest.fixture
def both_phases(write_run):
    for seed in (0, 1):
        write_run(f"plain{seed}", [f"seed={seed}"], seed, 0.30 + 0.1 * seed)  # scored before there were speed classes
        write_run(f"further{seed}", [], seed, 0.33 + 0.1 * seed, phase="phase1_further", speeds=True)
        write_run(f"full{seed}", ["phase=phase2"], seed, 0.38 + 0.1 * seed, phase="phase2", speeds=True)
        write_run(f"still{seed}", NO_VELOCITY, seed, 0.35 + 0.1 * seed, phase="phase2", speeds=True)
    write_run("radar", ["model.kggi=null", "model.ocsf=null"], 0, 0.2)


def rows(text, heading):
    """Lines of the table whose heading starts so, by label."""
    lines = text.split(heading)[1].splitlines()[2:]
    lines = lines[: next((i for i, line in enumerate(lines) if not line), len(lines))]
    return {line.split(" | ")[0].strip("| "): line for line in lines}


@pytest.mark.slow
def test_phase_2_is_held_against_phase_1(both_phases, report, tmp_path):
    text = report("phase2")
    summary = rows(text, "| experiment | mAP, % | NDS, % | mAVE, m/s |")
    assert list(summary) == [
        "phase 1", "phase 1 continued, no memory", "phase 2", "phase 2, no velocity compensation"
    ]  # fmt: skip
    assert summary["phase 2"].startswith("| phase 2 | **43.0** | **43.0** | **1.57** |")
    assert rows(text, "| experiment | mAP 0-0.5 m/s, % |")["phase 1"] == "| phase 1 |" + " – |" * 4
    assert "0-0.5 m/s 13 (cars 3), 0.5-10 m/s 13 (cars 3)" in text
    gain = rows(text, "| phase 2 over | seeds | mAP, % |")
    assert "| 2 | +8.0 [+8.0, +8.0] |" in gain["phase 1"]
    assert "| 2 | +5.0 [+5.0, +5.0] |" in gain["phase 1 continued, no memory"]
    fast = rows(text, "| phase 2 over | seeds | mAVE 0-0.5 m/s, m/s |")["phase 2, no velocity compensation"]
    assert fast.endswith("| -0.03 [-0.03, -0.03] |")
    for command in ("phase=phase1_further scale=mini seed=1", "phase=phase2 scale=mini seed=0"):
        assert f"python -m src.train {command}\n" in text
    assert Image.open(tmp_path / "reports" / "pictures" / "phase2_mini.png").width == 1600
    assert "(pictures/phase2_mini.png)" in text


@pytest.mark.slow
def test_phase_1_keeps_its_own_page(both_phases, report):
    text = report("phase1")
    assert list(rows(text, "| experiment | mAP, % | NDS, % | mAVE, m/s | car AP, % |")) == ["KGGI + OCSF", "radar only"]
    assert "further" not in text and "phase2" not in text


@pytest.mark.slow
def test_weights_scored_once_more_are_left_to_their_sweeps(both_phases, write_run, report):
    before = [report(phase) for phase in ("phase1", "phase2")]
    again = ["phase.epochs=0", "model.head.nms=circle"]
    write_run("one", [*again, "phase.init_from=horizon3d-phase1-mini-0123abcd"], 0, 0.9, epochs=0)
    write_run("two", [*again, "phase.init_from=horizon3d-phase2-mini-0123abcd"], 0, 0.9, phase="phase2", epochs=0)
    assert [report(phase) for phase in ("phase1", "phase2")] == before


@pytest.mark.slow
def test_a_start_from_the_id_of_the_usual_run_is_no_setting(write_run, report):
    for seed, settings in ((0, []), (1, []), (2, ["model.channels=32"])):
        write_run(f"0000000{seed}", settings, seed, 0.3)
        source = f"horizon3d-phase1-mini-0000000{seed}"
        write_run(f"full{seed}", ["phase=phase2"], seed, 0.4, phase="phase2", source=source)
    write_run("other", ["phase=phase2"], 1, 0.4, phase="phase2", source="horizon3d-phase1-mini-00000000")
    for name, setting in (("alone", "model.dptf.gaussian_path=null"), ("narrow", "model.ocsf.margin_m=1.6")):
        write_run(name, [setting], 0, 0.4, phase="phase2", source="horizon3d-phase1-mini-00000000")
    summary = rows(report("phase2"), "| experiment | mAP, % | NDS, % | mAVE, m/s |")
    started = [f"phase 2, `phase.init_from=horizon3d-phase1-mini-0000000{other}`" for other in (0, 2)]
    narrow = "phase 2, `model.ocsf.margin_m=1.6 phase.init_from=horizon3d-phase1-mini-00000000`"  # of another phase 1
    names = ["phase 1", "phase 2", "phase 2, `model.dptf.gaussian_path=null`", narrow, *started]
    assert sorted(summary) == sorted(names)


@pytest.mark.slow
def test_an_unnamed_setting_shows_itself_last(both_phases, write_run, report):
    write_run("a", ["model.dptf.gaussian_path.sampling=random"], 0, 0.9, phase="phase2")
    names = list(rows(report("phase2"), "| experiment | mAP, % | NDS, % | mAVE, m/s |"))
    assert names[-1] == "phase 2, `model.dptf.gaussian_path.sampling=random`"


@pytest.mark.slow
def test_runs_with_sensor_dropout_have_tables_of_their_own(both_phases, write_run, report):
    for seed, (with_velocity, without) in enumerate([(0.3, 0.2), (0.4, 0.2)]):
        write_run(f"with-{seed}", ["data.sensor_dropout=0.25"], seed, with_velocity, phase="phase2")
        write_run(f"without-{seed}", ["data.sensor_dropout=0.25", *NO_VELOCITY], seed, without, phase="phase2")
    seen, dropout = report("phase2").split("## With sensor dropout")
    for part in seen.split("```")[2:]:  # after the commands
        assert "dropout" not in part
    names = ["phase 2, `data.sensor_dropout=0.25`", "phase 2, no velocity compensation, `data.sensor_dropout=0.25`"]
    assert list(rows(dropout, "| experiment | mAP, % | NDS, % | mAVE, m/s |")) == names
    gains = rows(dropout, f"| {names[0]} over | seeds | mAP, % |")
    assert "| 2 | +15.0 [-48.5, +78.5] undecided |" in gains[names[1]]


def test_phase_2_without_its_plain_run_has_no_gains(write_run, report):
    write_run("a", NO_VELOCITY, 0, 0.3, phase="phase2")
    assert "Gain" not in report("phase2")


@pytest.mark.slow
def test_runs_on_recorded_data_are_reported_without_the_data(write_run, report):
    for seed in (0, 1):
        write_run(
            f"s{seed}", ["scale=paper", "data.root=/data/man", f"seed={seed}"], seed, 0.2 + 0.1 * seed, scale="paper"
        )
    assert "25.0" in rows(report("phase1", "paper"), "| experiment | mAP, % |")["KGGI + OCSF"]


@pytest.mark.slow
def test_no_run_of_the_phase_itself(write_run, report):
    write_run("further", [], 0, 0.3, phase="phase1_further")
    for phase in ("phase1", "phase2"):
        with pytest.raises(DataError, match=f"no finished run of {phase} at scale=mini"):
            report(phase)


def test_runs_on_other_data_are_left_out_and_named(both_phases, write_run, report):
    before = [report(phase) for phase in ("phase1", "phase2")]
    write_run("other", ["phase=phase2"], 5, 0.9, phase="phase2", root="elsewhere")
    for end in ("more", "most", "even"):  # runs without settings decide, not these three
        write_run(end, [f"x={end}"], 0, 0.9, root="world|3")
    said = "\nLeft out, since a table never mixes data: "
    assert (
        report("phase1")
        == before[0]
        + said
        + ", ".join(f"`horizon3d-phase1-mini-{end}` (synthetic highway world\\|3)" for end in ("even", "more", "most"))
        + ".\n"
    )
    assert report("phase2") == before[1] + said + "`horizon3d-phase2-mini-other` (synthetic highway elsewhere).\n"


def test_without_a_plain_run_the_data_of_most_are_shown(write_run, report):
    for end, root in (("a", "z"), ("b", "world"), ("c", "world")):
        write_run(end, [f"x={end}"], 0, 0.3, root=root)
    assert list(rows(report("phase1"), "| experiment | mAP, % |")) == ["`x=b`", "`x=c`"]


@pytest.mark.slow
def test_everything_of_a_scale_is_written(both_phases, report, tmp_path, make_record, exported):
    record = make_record({"4.8 m": {"mAP": 20.3}}, seeds=1)
    write_record(record_path(tmp_path / "reports", "epsilon", "mini"), record)
    write_record(
        record_path(tmp_path / "reports", "other", "debug"), make_record({"x": {}}, scale="debug", name="other")
    )
    report("phase1")
    reports = tmp_path / "reports"
    assert {path.name for path in reports.iterdir()} >= {"phase1_mini.md", "phase2_mini.md", "results", "tables"}
    assert len(list((reports / "results").iterdir())) == 9
    assert {path.name for path in (reports / "tables").iterdir()} == {
        f"table_epsilon_mini.{ending}" for ending in ("md", "csv", "tex")
    }
    assert exported == [(reports, tmp_path, reports / "dashboard.html")]


@pytest.mark.slow
def test_results_outlive_their_runs(both_phases, report, tmp_path):
    before = report("phase2")
    for record in tmp_path.glob("*/run.json"):
        record.unlink()
    assert report("phase2") == before


@pytest.mark.slow
def test_what_is_broken_is_named_after_the_rest(both_phases, write_run, tmp_path, report):
    broken = write_run("broken", [], 7, 0.9)
    (broken / "metrics.json").write_text("{")
    reports = tmp_path / "reports"
    (reports / "results").mkdir(parents=True)
    (reports / "sweeps").mkdir()
    result_path(reports, "horizon3d-phase1-mini-old").write_text('{"format": 0}')
    record_path(reports, "torn", "mini").write_text("{")
    with pytest.raises(DataError) as raised:
        report("phase2")
    assert raised.value.exit_code == 4
    for name in ("broken/metrics.json", "horizon3d-phase1-mini-old.json: format must be", "torn_mini.json"):
        assert name in str(raised.value)
    assert "phase 2" in (reports / "phase2_mini.md").read_text()


@pytest.mark.slow
def test_sweeps_with_different_data_stop_no_other(both_phases, write_run, tmp_path, report, make_record):
    for end, root in (("a0", "world"), ("b0", "elsewhere"), ("c0", "world")):
        write_run(end, [f"x={end}"], 0, 0.3, root=root)
    reports = tmp_path / "reports"
    write_record(record_path(reports, "mixed", "mini"), make_record({"a": {}, "b": {}}, seeds=1, name="mixed"))
    write_record(record_path(reports, "pure", "mini"), make_record({"a": {}}, seeds=1, name="pure"))
    with pytest.raises(DataError, match="sweep mixed, scale mini: a table never mixes"):
        report("phase2")
    assert [path.name for path in (reports / "tables").glob("*.md")] == ["table_pure_mini.md"]


@pytest.mark.slow
def test_rows_of_sweeps_do_not_flood_the_pages(both_phases, write_run, tmp_path, report, make_record):
    write_run("a0", ["model.ocsf.margin_m=0.8"], 0, 0.9)  # a row of the sweep
    write_run("b0", ["model.ocsf.margin_m=4.8"], 2, 0.5)  # its baseline, which is the plain run with another seed
    write_run("c0", ["model.kggi.initialization=random"], 0, 0.2)  # a row that has a name on the page
    write_run("d0", ["model.ocsf.num_layers=4"], 0, 0.1)  # of no sweep
    record = make_record({"0.8 m": {}, "4.8 m": {}, "random": {}}, seeds=1)
    record.rows["4.8 m"] = {2: record.rows["4.8 m"][0]}
    record.runs[record.rows["4.8 m"][2]].seed = 2
    write_record(record_path(tmp_path / "reports", "epsilon", "mini"), record)
    text = report("phase1")
    summary = rows(text, "| experiment | mAP, % | NDS, % | mAVE, m/s | car AP, % |")
    assert list(summary) == ["KGGI + OCSF", "OCSF, random Gaussians", "radar only", "`model.ocsf.num_layers=4`"]
    assert summary["KGGI + OCSF"].startswith("| KGGI + OCSF | 40.0 |")  # 30, 40 and 50
    assert "margin_m" not in text
    assert "margin_m" not in report("phase2")


def test_overrides_that_say_the_default_are_none():
    defaults = {"seed": 0, "model": {"name": "horizon3d", "kggi": {"init": "both"}, "margin_m": 4.8, "dptf": None},
                "backbone": {"name": "small", "lr": 1.0}, "flag": True}  # fmt: skip
    same = ["model=horizon3d", "model.kggi.init=both", "model.margin_m=4.80", "model.dptf=null", "backbone=small",
            "flag=true", "++model.margin_m=4.8"]  # fmt: skip
    assert without_defaults(same, defaults) == []
    other = ["model.kggi=null", "model.margin_m=0.8", "backbone=vovnet99", "backbone.lr=1.0", "flag=1", "new.key=1",
             "model.list=[1"]  # fmt: skip
    assert without_defaults(other, defaults) == other  # backbone.lr is inside a backbone with a default of its own
    assert without_defaults(["model.margin_m=0.8", "model.margin_m=4.8"], defaults) == []  # the later wins
    assert without_defaults(["model.margin_m=4.8", "model.margin_m=0.8"], {}) == ["model.margin_m=0.8"]


def test_an_older_default_is_a_setting_today(make_result):
    today = {"seed": 0, "phase": {"name": "phase2", "temporal": True, "epochs": 4},
             "data": {"stream_sets": 5, "timeline": "key", "root": None},
             "model": {"head": {"nms": "maxpool"}, "kggi": {"init": "both"}, "new": 1}}  # fmt: skip
    then = {"seed": 1, "phase": {"name": "phase2", "temporal": True, "epochs": 6}, "data": {"stream_sets": 8},
            "model": {"head": {"nms": "per_group"}, "kggi": {"init": "random"}, "gone": 2}}  # fmt: skip
    run = make_result("a", {}, config=then, overrides=["phase.epochs=6", "model.kggi={init: random}"])
    assert changed_since(run, today) == ["data.stream_sets=8", "data.timeline=null", "model.head.nms=per_group"]
    then["phase"]["temporal"] = False  # what changes nothing there
    assert changed_since(run, today) == ["data.timeline=null", "model.head.nms=per_group"]
    assert changed_since(run, then) == []


def test_an_experiment_stands_with_all_its_seeds_or_not_at_all(make_result):
    """Whether a sweep has run some of them or all."""
    runs = [
        make_result(f"horizon3d-phase1-mini-{seed}", {"mAP": 0.1}, seed, overrides=["model=dense_bev"])
        for seed in range(3)
    ]
    names = [run.run_id for run in runs]
    assert runs_on_page(runs, "phase1", set()) == runs_on_page(iter(runs), "phase1", set(names[:2])) == runs
    assert runs_on_page(runs, "phase1", set(names)) == []


def test_the_page_of_another_task_is_shown(write_run, tmp_path, capsys, exported):
    folder = write_run("0123abcd", [], 0, 0.3, phase="lrs_occupancy")
    config = folder / "config.yaml"
    config.write_text(config.read_text().replace("name: horizon3d", "name: lrs4fusion"))
    record = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps(record | {"task": "occupancy", "headline": "iou"}))
    (folder / "metrics.json").write_text(json.dumps({"iou": 0.7125}))
    paths = [f"paths.outputs={tmp_path}", f"paths.reports={tmp_path / 'reports'}"]
    main(["model=lrs4fusion", "phase=lrs_occupancy", "scale=mini", *paths])
    assert "| 71.2" in capsys.readouterr().out.split("written:")[0]


@pytest.mark.slow
def test_runs_of_a_world_model_with_other_defaults_are_other_experiments(write_run, tmp_path):
    choices = ["scale=mini", "phase=lrs_occupancy", "model=lrs4fusion"]
    run = read_result(publish_result(write_run("0123abcd", choices[2:], 0, 0.3), tmp_path / "reports"))
    tree = compose_config(choices)[1]
    older = copy.deepcopy(tree)
    older["data"]["timeline"]["radial_speeds"], older["model"]["loss"]["sampling"]["free_places"] = "none", "along_rays"
    results = {
        name: replace(
            run, run_id=name, seed=name == "again", task="occupancy", headline="iou", model="lrs4fusion",
            phase="lrs_occupancy", config=config, metrics={"iou": iou}, overrides=[*choices[2:], *settings],
        )
        for name, config, iou, settings in (
            ("today", tree, 0.5, []), ("again", tree, 0.7, ["model.channels=32"]), ("older", older, 0.4, []),
        )
    }  # fmt: skip
    config = compose_config([*choices, f"paths.reports={tmp_path / 'reports'}"])[0]
    (page,) = write_pages(config, results, set()).values()
    found = rows(page.read_text(), "| experiment | occupancy IoU along rays, % |")
    changed = "data.timeline.radial_speeds=none model.loss.sampling.free_places=along_rays model=lrs4fusion"
    assert found == {"LRS4Fusion": "| LRS4Fusion | 60.0 |", f"`{changed}`": f"| `{changed}` | 40.0 |"}
    (page,) = write_pages(config, results, set(results)).values()  # all of them in tables of sweeps as well
    assert rows(page.read_text(), "| experiment | occupancy IoU") == {"LRS4Fusion": "| LRS4Fusion | 60.0 |"}
