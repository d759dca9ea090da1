"""`python -m src.sweep`: the plan of real configurations, refusals, and one sweep with real trainings."""

import json
import logging
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from src.config import PHASES, compose_config
from src.errors import ConfigError, HorizonError
from src.report.sweep_record import read_record
from src.sweep import __main__ as sweep
from src.sweep import latency_runs, sweep_files
from src.sweep.latency_runs import measure_latencies
from src.sweep.run_plan import Identifier
from src.training.handoff import find_source
from src.training.identity import run_identity
from tests.sweep.fake_sweep import make_runner, make_sweep

ROOT = Path(__file__).resolve().parents[2]
FILE = """title: Two margins
question: Does a larger margin help?
overrides: [phase=phase1]
baseline: large
tables: [{name: two, title: Two margins, columns: [mAP, NDS]}]
rows:
  - {label: small, overrides: [model.ocsf.margin_m=0.8], paper: {mAP: 18.6}}
  - {label: large, overrides: [model.ocsf.margin_m=4.8], paper: {mAP: 20.3}}
"""


@pytest.fixture
def sweeps(tmp_path, monkeypatch):
    """A folder of sweeps with `two`, and the overrides that keep everything in the test's folder."""
    folder = tmp_path / "sweeps"
    folder.mkdir()
    (folder / "two.yaml").write_text(FILE)
    monkeypatch.setattr(sweep_files, "SWEEPS", folder)
    monkeypatch.chdir(ROOT)
    return folder


@pytest.fixture
def places(tmp_path):
    return [f"paths.outputs={tmp_path / 'outputs'}", f"paths.reports={tmp_path / 'reports'}"]


@pytest.mark.slow
def test_run_ids_are_those_of_the_training_command():
    identify = Identifier()
    for overrides in (
        ["scale=debug", "phase=phase1", "seed=7"],
        [
            "scale=debug",
            "phase=phase2",
            "model.dptf.bev_path=null",
            "model.ocsf.margin_m=0.8",
            "seed=3",
            "optim.lr=1e-3",
        ],
        ["seed=0", "phase=phase2", "scale=debug"],
    ):
        config, tree = compose_config(overrides)
        source = find_source(config, overrides, compose_config, PHASES)
        found = identify(overrides)
        assert found.run_id == run_identity(tree, source.identity if source is not None else None)
        assert found.source == (source.overrides if source is not None else None)
    with pytest.raises(ConfigError, match="seed must be"):
        identify(["seed=99999999999"])


@pytest.mark.slow
def test_dry_run_prints_commands_and_touches_nothing(sweeps, places, tmp_path, capsys):
    (sweeps / "paths.yaml").write_text(
        "title: t\nquestion: q\nrows:\n"
        "  - {label: without, overrides: [phase=phase2, model.dptf.bev_path=null]}\n"
        "  - {label: both, overrides: [phase=phase2]}\n"
        "  - {label: again, overrides: [phase=phase2, data.num_workers=0]}\n"
    )
    sweep.main(["+sweep=paths", "scale=debug", "seeds=2", "seed=5", "dry_run=true", *places])
    out = capsys.readouterr().out
    assert "3 rows x 2 seeds = 6 results of 6 runs, 0 finished" in out
    commands = [line for line in out.splitlines() if line.startswith("python -m src.train ")]
    assert (
        len(commands) == len(set(commands)) == 6
        and ["seed=5" in command for command in commands] == [True] * 3 + [False] * 3
    )
    assert "phase=phase1" in commands[0] and "model.dptf" not in commands[0] and "phase=phase2" in commands[1]
    assert "# both = again, seed 5 (2 rows that coincide share it)" in out
    assert not (tmp_path / "outputs").exists() and not (tmp_path / "reports").exists()


@pytest.mark.slow
def test_refusals_come_before_anything_starts(sweeps, places, tmp_path):
    def refused(said, *words, kind=ConfigError):
        with pytest.raises(kind, match=said) as caught:
            sweep.main([*words, "scale=debug", *places])
        assert "s3cret" not in str(caught.value) and not list(tmp_path.glob("outputs/*phase*"))

    refused("there is no sweeps/nope.yaml", "+sweep=nope")
    refused(r"^Could not override 'optim.lrr'|optim.lrr", "+sweep=two", "optim.lrr=1")
    (sweeps / "bad.yaml").write_text(FILE.replace("margin_m=4.8", "margin=4.8"))
    refused(r"sweeps/bad.yaml, row 'large': .*did you mean model.ocsf.margin_m", "+sweep=bad")
    (sweeps / "nan.yaml").write_text(FILE.replace("margin_m=4.8", "margin_m=nan"))
    refused(r"sweeps/nan.yaml, row 'large': .*margin_m", "+sweep=nan")
    refused("database of the sweep cannot be used", "+sweep=two", "storage=nosuch://me:s3cret@host/db")
    broken = tmp_path / "broken.db"
    broken.write_bytes(os.urandom(3000))
    refused("not a database", "+sweep=two", f"storage=sqlite:///{broken}")
    (sweeps / "space.yaml").write_text(
        "title: t\nquestion: q\ntrials: 3\nspace: {optim.lr: {low: 1.0e-5, high: 1.0e-3, log: true}}\n"
    )
    refused("a search compares single runs", "+sweep=space", "seeds=2")


def test_a_search_is_described(sweeps, places, capsys):
    (sweeps / "space.yaml").write_text(
        "title: t\nquestion: q\ntrials: 3\nspace:\n"
        "  optim.lr: {low: 1.0e-5, high: 1.0e-3, log: true}\n  model.head.score_threshold: {choices: [0.02, 0.1]}\n"
    )
    sweep.main(["+sweep=space", "scale=debug", "dry_run=true", *places])
    out = capsys.readouterr().out
    assert "a search of 3 trials for the best NDS" in out and "optim.lr: 1e-05 to 0.001, logarithmic" in out


@pytest.mark.slow
def test_the_command_ends_with_its_exit_code_and_one_message(tmp_path):
    command = [sys.executable, "-m", "src.sweep", "+sweep=epsilom", f"paths.outputs={tmp_path}"]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert ended.returncode == 3 and "did you mean epsilon?" in ended.stderr and "Traceback" not in ended.stderr


@pytest.mark.slow
def test_latency_is_measured_once_per_row_and_a_failure_is_told(tmp_path, monkeypatch, caplog):
    monkeypatch.chdir(ROOT)
    published = []
    runner = make_runner(
        tmp_path, make_sweep({"a": ["model.x=1"], "b": ["model.x=2"]}), seeds=(0, 1), publish=published.append
    )
    record = runner.run()
    outputs = tmp_path / "outputs"
    bad = record.rows["b"][0]

    for run_id in record.runs:  # weights are here
        (outputs / run_id / "checkpoints").mkdir()
        (outputs / run_id / "checkpoints" / "last.ckpt").write_text("")

    def command(outputs, folder, words):
        assert words[:1] == [f"checkpoint={folder / 'checkpoints' / 'last.ckpt'}"]
        code = (
            "raise SystemExit('DataError: no frames')"
            if folder.name == bad
            else "open(__import__('sys').argv[1], 'w').write('{}')"
        )
        return [sys.executable, "-c", code, str(folder / "latency.json")]

    monkeypatch.setattr(latency_runs, "latency_command", command)
    published.clear()
    places = outputs, tmp_path / "reports", runner
    with caplog.at_level(logging.WARNING):
        (problem,) = measure_latencies(record, *places)
    assert "[b]: no latency" in problem and "no frames" in problem and problem in caplog.text
    assert published == [outputs / record.rows["a"][0]]
    assert len(measure_latencies(record, *places)) == 1 and len(published) == 1  # b fails again, a has its own
    assert len(measure_latencies(record, *places, every=True)) == 1 and len(published) == 2


@pytest.mark.slow
@pytest.mark.exhaustive
def test_results_of_other_machines_are_given_a_latency_of_fresh_weights(sweeps, places, tmp_path, capsys, monkeypatch):
    """Their weights are not here; the table says so."""
    words = ["+sweep=timed", "scale=debug", "phase.epochs=1", "trainer.num_pictures=0", "trainer=cpu", *places]
    (sweeps / "timed.yaml").write_text(
        "title: t\nquestion: q\nlatency: true\ntables: [{name: t, title: T, columns: [mAP, latency.total]}]\n"
        "rows: [{label: radar, overrides: [model.kggi=null, model.ocsf=null]}]\n"
    )
    sweep.main(words)
    trained = capsys.readouterr().out
    assert "fresh weights" not in trained
    (path,) = (tmp_path / "reports" / "results").glob("*.json")
    before = json.loads(path.read_text())
    sweep.main([*words, "workers=0", "seed=1", "latency=true"])  # seed 0 is of an earlier command
    again = json.loads(path.read_text())
    assert again["latency"]["trained"] is True and again["latency"] != before["latency"], "its weights are here"
    assert "fresh weights" not in capsys.readouterr().out
    before = again
    shutil.rmtree(tmp_path / "outputs")
    sweep.main([*words, "workers=0"])
    assert "1 of 1 done" in capsys.readouterr().out, "its result lies in reports"
    sweep.main([*words, "published=true", "workers=0"])
    assert json.loads(path.read_text()) == before and "fresh weights" not in capsys.readouterr().out
    sweep.main([*words, "published=true", "workers=0", "latency=true"])
    after = json.loads(path.read_text())
    assert "Latency on" in (out := capsys.readouterr().out) and "of fresh weights that are as busy" in out
    assert after["latency"]["trained"] is False and after["latency"] != before["latency"]
    assert after | {"latency": None} == before | {"latency": None}
    assert not list((tmp_path / "outputs").glob("horizon3d-*"))
    monkeypatch.setattr(latency_runs, "latency_command", lambda *_: [sys.executable, "-c", "raise SystemExit('no')"])
    with pytest.raises(HorizonError, match=r"\[radar\]: no latency of .*: no .exit code 1.; log: "):
        sweep.main([*words, "published=true", "workers=0", "latency=true"])
    with pytest.raises(ConfigError, match=r"latency=true: sweeps/two.yaml does not say latency: true"):
        sweep.main(["+sweep=two", "scale=debug", "latency=true", *places])


@pytest.mark.slow
def test_a_real_sweep_ends_with_its_table_and_goes_on_from_there(sweeps, places, tmp_path, capsys):
    words = ["+sweep=two", "scale=debug", "phase.epochs=1", "trainer.num_pictures=0", "workers=2", *places]
    sweep.main(words)
    out = capsys.readouterr().out
    (path,) = (tmp_path / "reports" / "sweeps").glob("*.json")
    record = read_record(path)
    assert record.changes == ["phase.epochs=1"] and record.stem == path.stem == f"two_debug{record.suffix}"
    assert "| small | 18.6 \\| " in out and f"two-debug{record.suffix}: 2 of 2 done" in out
    assert "scale debug; with phase.epochs=1;" in out
    assert record.count("done") == 2 and record.command.startswith("python -m src.sweep +sweep=two scale=debug")
    outputs = tmp_path / "outputs"
    for run_id, run in record.runs.items():
        made = json.loads((outputs / run_id / "run.json").read_text())
        assert [o for o in made["overrides"] if not o.startswith(("paths.", "trainer."))] == run.overrides
        assert run.overrides == ["phase=phase1", run.overrides[1], "scale=debug", "phase.epochs=1", "seed=0"]
        assert run.ended - run.started >= made["seconds"]["all"]
        assert (tmp_path / "reports" / "results" / f"{run_id}.json").is_file()
    for suffix in ("md", "csv", "tex"):
        assert (tmp_path / "reports" / "tables" / f"{record.stem}.{suffix}").is_file()

    made = {path: path.stat().st_mtime_ns for path in outputs.glob("horizon3d-*/*") if path.name != ".lock"}
    began = time.monotonic()
    sweep.main(words)
    assert time.monotonic() - began < 20  # ten on a quiet machine
    assert made == {path: path.stat().st_mtime_ns for path in outputs.glob("horizon3d-*/*") if path.name != ".lock"}

    damaged = tmp_path / "damaged.ckpt"
    damaged.write_bytes(b"no checkpoint")
    text = FILE + f"  - {{label: damaged, overrides: [phase.init_from={damaged}]}}\n"
    (sweeps / "two.yaml").write_text(text)
    with pytest.raises(HorizonError, match="1 of 3 runs failed") as caught:
        sweep.main(words)
    said = str(caught.value)
    assert "damaged, seed 0" in said and "damaged.ckpt is truncated" in said and caught.value.exit_code == 1
    assert "damaged" in (tmp_path / "reports" / "tables" / f"{record.stem}.md").read_text()


def test_a_table_of_another_sweep_is_not_replaced(sweeps, places, tmp_path):
    content = "title: t\nquestion: q\ntables: [{name: same, title: T, columns: [mAP]}]\nrows: [{label: a}]\n"
    for name in ("first", "second"):
        (sweeps / f"{name}.yaml").write_text(content)
    sweep.main(["+sweep=first", "scale=debug", "workers=0", *places])
    before = {path.name: path.read_bytes() for path in (tmp_path / "reports").rglob("*.*") if path.is_file()}
    with pytest.raises(ConfigError, match=r"sweeps/second.yaml: sweep first has tables of the same name.*: same"):
        sweep.main(["+sweep=second", "scale=debug", "workers=0", *places])
    assert before == {path.name: path.read_bytes() for path in (tmp_path / "reports").rglob("*.*") if path.is_file()}
