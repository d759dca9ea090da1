"""`python -m src.study`: what each look trains, with a runner that makes results up instead of training."""

import json

import pytest

from src.errors import ConfigError, DataError, HorizonError, InterruptedRunError
from src.report.claims import load_claims
from src.report.sweep_record import read_record
from src.study import __main__ as study
from src.sweep import run_plan, sweep_files
from src.sweep.record_writer import RecordWriter
from src.sweep.run_plan import Identifier, definition
from src.sweep.sweep_study import SweepStudy, default_storage
from tests import finished_runs
from tests.sweep.fake_train import identify

SWEEPS = {
    "margin": ["none", "small", "large"],
    "layers": ["one", "two"],
}
CLAIMS = {
    "half_width": 0.1,
    "claims": [
        {
            "name": "margin", "sentence": "Larger is better", "source": "Table 1",
            "comparisons": [{"sweep": "margin", "row": "large", "over": "small", "metrics": ["mAP"]}],
        },
        {
            "name": "layers", "sentence": "Two are better", "source": "Table 2",
            "comparisons": [{"sweep": "layers", "row": "two", "over": "one", "metrics": ["mAP"]}],
        },
    ],
}  # fmt: skip
GAIN = {"large": [2.0, 2.1, 1.9] * 4, "two": [2.0, 1.0, 0.9, 1.0, 1.2, 1.1, *[1.0] * 6]}
"""Over the other rows, by seed, in percent: the first is decided at three pairs, the second at six."""


class FakeIdentifier(Identifier):
    def __call__(self, overrides):
        return identify(overrides)


def record_of(folder, sweep):
    return read_record(folder / "reports" / "sweeps" / f"{sweep}_debug.json")


@pytest.fixture
def places(tmp_path, monkeypatch):
    """Two sweeps and two claims on them, and the overrides that keep everything in the test's folder."""
    folder = tmp_path / "sweeps"
    folder.mkdir()
    for name, labels in SWEEPS.items():
        rows = [{"label": label, "overrides": [f"model.{name}={label}"]} for label in labels]
        (folder / f"{name}.yaml").write_text(json.dumps({"title": "t", "question": "q?", "rows": rows}))
    (tmp_path / "claims.yaml").write_text(json.dumps(CLAIMS))
    monkeypatch.setattr(sweep_files, "SWEEPS", folder)
    monkeypatch.setattr(study, "load_claims", lambda load: load_claims(load, tmp_path / "claims.yaml"))
    monkeypatch.setattr(study, "BESIDE", ())
    monkeypatch.setattr(run_plan, "Identifier", FakeIdentifier)
    return ["scale=debug", f"paths.outputs={tmp_path / 'outputs'}", f"paths.reports={tmp_path / 'reports'}"]


@pytest.fixture
def trained(monkeypatch):
    """Stands for the runner: finishes every run of a plan. Returns (sweep, runs that were not there, by row) a call."""
    results, calls = {}, []

    def finish_all(plan, command, call):
        new = {}
        for spec in plan.specs.values():
            if spec.run_id in results or spec.run_id in plan.published or not command.workers:
                continue
            new.setdefault(spec.label, []).append(spec.seed)
            value = 0.1 + GAIN.get(spec.label, [0.0] * 12)[spec.seed] / 100
            folder = call.outputs / spec.run_id
            folder.mkdir(parents=True)
            (folder / "run.json").write_text("{}")
            (folder / "metrics.json").write_text(json.dumps({"mAP": value}))
            results[spec.run_id] = finished_runs.result(
                spec.run_id, {"mAP": value}, spec.seed, scale="debug", seconds={"all": 60.0}
            )
        shared = SweepStudy(call.outputs, plan.study, default_storage(call.outputs), definition(plan, call.common))
        RecordWriter(plan, shared, call.resume_command, call.outputs, call.reports).write()
        calls.append((plan.sweep.name, new))

    monkeypatch.setattr(study, "run_plan", finish_all)
    monkeypatch.setattr(study.Study, "results", lambda self: dict(results))
    return calls, results


def test_seeds_are_added_to_what_is_open_and_to_nothing_else(places, trained, capsys):
    calls, _ = trained
    study.main(places)
    three = [0, 1, 2]
    assert calls == [
        ("margin", {"none": three, "small": three, "large": three}),
        ("layers", {"one": three, "two": three}),
        ("layers", {"one": [3, 4, 5], "two": [3, 4, 5]}),
    ]
    assert capsys.readouterr().out == "margin: shows (Larger is better)\nlayers: shows (Two are better)\n"
    calls.clear()
    study.main(places)  # nothing is open: the first look is shown again
    assert calls == [("margin", {}), ("layers", {})]


def test_sweeps_that_no_claim_names_stand_last_and_at_the_first_look(places, trained, monkeypatch, tmp_path):
    calls, _ = trained
    rows = [{"label": label, "overrides": [f"model.width={label}"]} for label in ("narrow", "wide")]
    (tmp_path / "sweeps" / "width.yaml").write_text(json.dumps({"title": "t", "question": "q?", "rows": rows}))
    monkeypatch.setattr(study, "BESIDE", ("width",))
    study.main(places)
    assert [name for name, _ in calls] == ["margin", "layers", "width", "layers"]
    assert calls[2][1] == {"narrow": [0, 1, 2], "wide": [0, 1, 2]}


def test_every_sweep_of_accuracy_is_of_a_claim_or_beside_them():
    named = {measure.comparison.sweep for claim in load_claims(sweep_files.load_sweep) for measure in claim.measures}
    files = {path.stem for path in sweep_files.SWEEPS.glob("*.yaml") if not path.stem.startswith("lrs_")}
    assert not named & set(study.BESIDE)
    assert files == named | set(study.BESIDE) | {"learning_rates", "tune"}


def test_rows_outside_the_open_comparisons_stay_at_the_first_look(places, trained, monkeypatch):
    calls, _ = trained
    monkeypatch.setitem(GAIN, "large", [9.0, -9.0] * 6)
    study.main(places)
    assert [new for name, new in calls if name == "margin"][1:] == [
        {"small": [3, 4, 5], "large": [3, 4, 5]},
        {"small": [*range(6, 12)], "large": [*range(6, 12)]},
    ]


@pytest.fixture
def claim_of_two(tmp_path, places):
    """The first claim also wants the largest to be better than none."""
    both = [{"sweep": "margin", "row": "large", "over": row, "metrics": ["mAP"]} for row in ("small", "none")]
    claims = [CLAIMS["claims"][0] | {"comparisons": both}, CLAIMS["claims"][1]]
    (tmp_path / "claims.yaml").write_text(json.dumps(CLAIMS | {"claims": claims}))
    return places


def test_a_claim_that_one_measure_does_not_show_is_not_open(claim_of_two, trained, monkeypatch, capsys):
    calls, _ = trained
    monkeypatch.setitem(GAIN, "small", [4.0] * 12)
    monkeypatch.setitem(GAIN, "none", [9.0, -9.0] * 6)
    study.main(claim_of_two)
    assert [name for name, _ in calls] == ["margin", "layers", "layers"]
    assert "margin: does not show" in capsys.readouterr().out


def test_without_workers_a_complete_comparison_does_not_wait_for_another(claim_of_two, trained, monkeypatch, tmp_path):
    calls, results = trained
    monkeypatch.setitem(GAIN, "large", [2.0, 1.0, 0.9, 1.0, 1.2, 1.1, *[1.0] * 6])
    study.main(claim_of_two)
    del results[record_of(tmp_path, "margin").rows["none"][5]]
    calls.clear()
    study.main([*claim_of_two, "published=true", "workers=0", f"paths.outputs={tmp_path / 'another'}"])
    assert [name for name, _ in calls] == ["margin", "layers", "margin", "layers"]


def test_a_row_that_never_finishes_gets_no_partners_beyond_the_first_look(places, trained, monkeypatch):
    calls, results = trained
    run_plan = study.run_plan

    def failing(plan, *rest):
        run_plan(plan, *rest)
        for run_id in plan.rows.get("large", {}).values():
            results.pop(run_id, None)

    monkeypatch.setattr(study, "run_plan", failing)
    study.main(places)
    assert [name for name, _ in calls] == ["margin", "layers", "layers"]


def test_a_plan_is_printed_with_the_time_that_it_takes(places, trained, capsys, tmp_path):
    calls, _ = trained
    study.main([*places, "dry_run=true"])
    out = capsys.readouterr().out.splitlines()
    assert not calls and not (tmp_path / "outputs").exists() and not (tmp_path / "reports").exists()
    assert out == [
        "# study at scale debug, 3 seeds: 0 of 15 done, 0 running, 15 left, time left unknown yet",
        "#   margin: none; small; large",
        "#   layers: one; two",
        "# study at scale debug, 6 seeds: 0 of 27 done, 0 running, 27 left, time left unknown yet" + study.ALL_OPEN,
        "#   margin: small; large",
        "#   layers: one; two",
        "# study at scale debug, 12 seeds: 0 of 51 done, 0 running, 51 left, time left unknown yet" + study.ALL_OPEN,
        "#   margin: small; large",
        "#   layers: one; two",
        "margin: not run (Larger is better)",
        "layers: not run (Two are better)",
    ]


def test_time_left_is_that_of_runs_finished_here(places, trained):
    _, results = trained
    study.main(places)
    here = study.read_study([*places, "workers=2"])
    steps = here.steps(12, {})  # as if no claim had a result: all is open
    assert here.progress(steps, 12, results) == (
        "study at scale debug, 12 seeds: 21 of 51 done, 0 running, 30 left, about 15 min left"
    )
    assert here.progress(steps, 12, {}).endswith("30 left, time left unknown yet")


def test_results_that_no_table_takes_are_refused(places, trained):
    _, results = trained
    study.main(places)
    first = next(iter(results.values()))
    first.data["root"] = "another"
    with pytest.raises(DataError, match=f"never mixes scales or data.*{first.run_id}"):
        study.main([*places, "dry_run=true"])


def test_a_sweep_that_fails_costs_no_other(places, trained, monkeypatch, capsys):
    calls, _ = trained
    run_plan = study.run_plan

    def failing(plan, *rest):
        if plan.sweep.name == "margin":
            raise HorizonError("1 of 9 runs failed")
        run_plan(plan, *rest)

    monkeypatch.setattr(study, "run_plan", failing)
    with pytest.raises(HorizonError, match="margin-debug: 1 of 9 runs failed"):
        study.main(places)
    assert {name for name, _ in calls} == {"layers"}
    assert "margin: not run" in capsys.readouterr().out

    def stopped(plan, *rest):
        raise InterruptedRunError("stopped")

    monkeypatch.setattr(study, "run_plan", stopped)
    with pytest.raises(InterruptedRunError):
        study.main(places)


def test_a_sweep_that_is_whole_at_its_next_look_has_not_failed(places, trained, monkeypatch, capsys):
    run_plan, failed = study.run_plan, []

    def failing(plan, *rest):
        run_plan(plan, *rest)
        if plan.sweep.name == "layers" and not failed:
            failed.append(plan)
            raise HorizonError("the table could not be written")

    monkeypatch.setattr(study, "run_plan", failing)
    study.main(places)
    assert failed and "layers: shows" in capsys.readouterr().out


def test_a_failure_is_told_whatever_ends_the_study(places, trained, monkeypatch, caplog):
    def failing(plan, *_):
        raise HorizonError("1 of 9 runs failed") if plan.sweep.name == "margin" else InterruptedRunError("stopped")

    monkeypatch.setattr(study, "run_plan", failing)
    with pytest.raises(InterruptedRunError):
        study.main(places)
    assert "margin-debug: 1 of 9 runs failed" in caplog.text


def test_finished_runs_that_lack_what_decides_are_named(places, trained, capsys, tmp_path):
    _, results = trained
    study.main(places)
    lacking = record_of(tmp_path, "layers").rows["one"][1]
    results[lacking].metrics["mAP"] = None
    capsys.readouterr()
    study.main([*places, "workers=0"])
    said = capsys.readouterr().out
    assert f"\n  two over one: no mAP in the results of {lacking}, whose pairs do not count" in said


def test_rows_that_the_command_line_makes_one_run_are_refused(places, trained, tmp_path):
    calls, _ = trained
    path = tmp_path / "sweeps" / "layers.yaml"
    path.write_text(path.read_text().replace("model.layers", "model.ocsf.num_layers"))
    message = "makes one run, .*, of 'two' and 'one' of sweeps/layers.yaml, which a claim compares; leave out"
    with pytest.raises(ConfigError, match=message):
        study.main([*places, "model.ocsf.num_layers=2"])
    assert not calls


def test_what_has_a_result_elsewhere_is_not_trained(places, trained, tmp_path):
    calls, results = trained
    study.main(places)
    calls.clear()
    gone = next(run_id for run_id, result in results.items() if result.seed == 1)
    del results[gone]
    study.main([*places, "published=true", f"paths.outputs={tmp_path / 'another'}"])
    assert [new for _, new in calls if new] == [{"none": [1]}]


def test_a_row_that_decides_nothing_keeps_the_seeds_that_its_record_has(places, trained, monkeypatch, tmp_path):
    calls, results = trained
    monkeypatch.setitem(GAIN, "none", [9.0, -9.0] * 6)
    asked = json.loads(json.dumps(CLAIMS))
    asked["claims"][0]["comparisons"][0] |= {"row": "small", "over": "none"}
    (tmp_path / "claims.yaml").write_text(json.dumps(asked))
    study.main(places)  # twelve seeds of both
    (tmp_path / "claims.yaml").write_text(json.dumps(CLAIMS))
    runs = record_of(tmp_path, "margin").rows["none"]
    for seed in range(9):
        del results[runs[seed]]
    calls.clear()
    published = [*places, "published=true", f"paths.outputs={tmp_path / 'another'}"]
    study.main(published)
    assert not any(new for _, new in calls) and list(record_of(tmp_path, "margin").rows["none"]) == [9, 10, 11]

    def planned(*overrides):
        return list(study.read_study([*published, *overrides]).steps(3, results)[0].plan.rows["none"])

    assert planned() == [9, 10, 11] and planned("published=false") == [0, 1, 2]  # it would train all of them
    path = tmp_path / "sweeps" / "margin.yaml"
    said = path.read_text()
    path.write_text(said.replace("model.margin=none", "model.margin=nothing"))
    assert planned() == [0, 1, 2]
    path.write_text(said)
    del results[runs[9]]  # two are too few
    study.main(published)
    assert ("margin", {"none": [0, 1, 2]}) in calls


def test_without_workers_no_look_follows_an_incomplete_one(places, trained, tmp_path, capsys):
    calls, results = trained
    study.main(places)
    before = capsys.readouterr().out
    of_results = [*places, "published=true", "workers=0", f"paths.outputs={tmp_path / 'another'}"]
    calls.clear()
    study.main(of_results)
    assert calls == [("margin", {}), ("layers", {}), ("layers", {})] and capsys.readouterr().out == before
    margin = {run for runs in record_of(tmp_path, "margin").rows.values() for run in runs.values()}
    del results[record_of(tmp_path, "margin").rows["none"][2]]  # it keeps no other sweep from its next look
    calls.clear()
    study.main(of_results)
    assert calls == [("margin", {}), ("layers", {}), ("layers", {})] and capsys.readouterr().out == before
    for run_id in [run_id for run_id, result in results.items() if result.seed == 2 or run_id not in margin]:
        del results[run_id]
    calls.clear()
    study.main(of_results)
    assert calls == [("margin", {})] and "margin: undecided" in capsys.readouterr().out


@pytest.mark.parametrize("override", ["published=true", "published=false"])
def test_without_workers_results_count_beside_what_is_finished_here(places, trained, tmp_path, override):
    study.main(places)
    first, *others = record_of(tmp_path, "margin").runs
    elsewhere = tmp_path / "another"
    elsewhere.mkdir()
    (tmp_path / "outputs" / first).rename(elsewhere / first)
    study.main([*places, "workers=0", override, f"paths.outputs={elsewhere}"])
    assert others and record_of(tmp_path, "margin").count("done") == 1 + len(others)


def test_another_experiment_has_records_of_its_own(places, trained, tmp_path):
    study.main([*places, "optim.lr=1"])
    assert [path.name for path in (tmp_path / "reports" / "sweeps").glob("margin_debug-*.json")]
    assert not (tmp_path / "reports" / "sweeps" / "margin_debug.json").exists()


def test_a_command_that_repeats_what_a_file_says_at_the_scale_finds_its_records(places, trained, tmp_path, capsys):
    path = tmp_path / "sweeps" / "margin.yaml"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"scale_overrides": {"debug": ["optim.lr=1"]}}))
    study.main([*places, "optim.lr=1"])
    assert "margin: not run" not in capsys.readouterr().out


@pytest.mark.parametrize("override", ["+sweep=margin", "seed=3", "seeds=12", "trials=3", "latency=true"])
def test_what_the_rule_sets_is_refused(places, override):
    message = r"the claims say which sweeps and seeds are run and measured; leave \w+= out"
    with pytest.raises(ConfigError, match=message):
        study.main([*places, override])
