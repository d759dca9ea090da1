"""What the dashboard reads: states, time left, baselines, broken files; nothing is read twice without a change."""

import json
import os
import time

import pytest

from src.dashboard import board as board_module
from src.dashboard.board import BoardReader, Sweep
from src.report.results import publish_result
from src.report.sweep_file import DimensionConfig, SweepConfig
from src.report.sweep_record import RunState, record_path, write_record
from tests.dashboard.experiments import EVIL, World, epsilon, write_run


def read(world):
    return BoardReader(world.reports, world.outputs).read()[0]


def state_of(states, idle_s=0.0, **fields):
    """A sweep whose six runs have these states; others are done."""
    record = epsilon("mini")
    for run in record.runs.values():
        run.started, run.ended = 9_000.0, 9_060.0
    for run, state in zip(record.runs.values(), states, strict=False):
        run.state = state
        for name, value in fields.items():
            setattr(run, name, value)
    return Sweep(record=record, tables=[], problem=None, written=10_000.0 - idle_s, now=10_000.0)


@pytest.mark.parametrize(
    "states, idle_s, expected",
    [([], 0, "done"), ([], 9999, "done"), (["failed"], 9999, "failed"), (["pruned"], 9999, "done"),
     (["running", "waiting"], 60, "running"), (["running", "waiting"], 180, "stalled"),
     (["waiting"], 60, "running"), (["waiting", "failed"], 180, "unfinished")],
)  # fmt: skip
def test_state_of_a_sweep(states, idle_s, expected):
    assert state_of(states, idle_s).state == expected


def test_a_search_is_not_done_while_trials_are_to_come():
    sweep = state_of([])
    search = SweepConfig(
        name="t", title="t", question="q", space={"optim.lr": DimensionConfig(low=0.0, high=1.0)}, trials=7
    )
    sweep.record.sweep, sweep.record.trials = search, 6
    assert sweep.state == "running" and sweep.left_s == pytest.approx(60.0) and sweep.record.planned == 7
    sweep.record.trials = 7
    assert sweep.state == "done"


def test_time_left_is_what_finished_runs_took():
    # Finished ones took 60 s; two run, since 20 s; one waits: (40 + 40 + 60) s of work on two workers.
    sweep = state_of(["running", "running", "waiting"], started=9_980.0)
    assert sweep.left_s == pytest.approx(70.0)
    assert state_of(["running"] * 6, started=9_980.0).left_s is None  # nothing to go by
    assert state_of(["running", "waiting"], 500.0).left_s is None  # it stands still


def test_what_is_read(world):
    board = read(world)
    assert [sweep.key for sweep in board.sweeps] == ["epsilon_mini"]
    assert board.scales == ["mini", "debug"]
    assert set(board.broken) == {"sweeps/old_mini.json", "results/horizon3d-phase1-mini-deadbeef.json"}
    assert all(str(world.reports) not in message for message in board.broken.values())
    failed = board.runs[world.run_id(1, 1)]
    assert (failed.state, failed.title, failed.seed) == ("failed", EVIL, 1)
    assert board.runs[world.run_id(0, 0)].settings == ("model.ocsf.margin_m=0.8",)
    assert not board.live


def test_a_silent_runner_whose_run_still_writes_is_alive(world):
    running = RunState(
        run_id=world.run_id(1, 1), overrides=[], seed=1, label=EVIL, state="running", started=1.0,
        log="sweeps/epsilon_mini/failed.log",
    )  # fmt: skip
    record = epsilon("mini", {(1, 1): running})
    record.updated = time.time() - 3600
    write_record(record_path(world.reports, "epsilon", "mini"), record)
    board = read(world)
    assert board.sweep("epsilon_mini").state == "running" and board.live
    os.utime(world.outputs / running.log, (1, 1))
    board = read(world)
    assert board.sweep("epsilon_mini").state == "stalled"
    assert board.runs[running.run_id].state == "stopped" and not board.live  # its runner was killed


def test_a_run_that_sweeps_share_is_in_the_state_of_the_one_that_trains_it(world):
    run_id = world.run_id(1, 1)
    for name, state in (("a_first", "waiting"), ("b_second", "running"), ("c_third", "waiting")):
        own = RunState(run_id=run_id, overrides=[], seed=1, label=EVIL, state=state, started=1.0)
        record = epsilon("mini", {(1, 1): own})
        record.sweep.name, record.updated = name, time.time()
        write_record(record_path(world.reports, name, "mini"), record)
    assert read(world).runs[run_id].state == "running"


def test_folders_without_a_result_are_running_or_stopped(world):
    for name, age_s in (("horizon3d-phase2-mini-0000001a", 10), ("horizon3d-phase2-mini-0000001b", 4000)):
        folder = write_run(world.outputs, name, 0, 0.3, 1.0)
        (folder / "metrics.json").unlink()
        for path in folder.iterdir():
            os.utime(path, (time.time() - age_s,) * 2)
    write_run(world.outputs, "horizon3d-phase2-mini-0000001c", 0, 0.3, 1.0)
    runs = read(world).runs
    assert [runs[f"horizon3d-phase2-mini-0000001{end}"].state for end in "abc"] == ["running", "stopped", "done"]


def test_baseline_is_the_sweeps_row_of_the_same_seed(world):
    board = read(world)
    other, name = board.baseline_of(board.runs[world.run_id(0, 1)])
    assert (other.run_id, name) == (world.run_id(2, 1), "4.8 m (baseline)")
    assert board.baseline_of(board.runs[world.run_id(2, 1)]) is None  # the baseline itself, and no run of defaults
    assert board.baseline_of(board.runs[world.run_id(0, 0, "debug")]) is None  # scales do not mix
    plain = write_run(world.outputs, "horizon3d-phase1-debug-0000002a", 0, 0.1, 4.8)
    record = json.loads((plain / "run.json").read_text())
    (plain / "run.json").write_text(json.dumps(record | {"overrides": ["phase=phase1", "seed=0", "scale=debug"]}))
    publish_result(plain, world.reports)
    board = read(world)
    run = board.runs[world.run_id(0, 0, "debug")]
    assert board.baseline_of(run)[0].run_id == plain.name
    run.result.data["root"] = "another world"
    assert board.baseline_of(run) is None  # its numbers say nothing about these


def test_results_of_different_data_have_no_table_but_a_reason(world):
    path = world.reports / "results" / f"{world.run_id(0, 0)}.json"
    content = json.loads(path.read_text())
    content["data"]["root"] = "another_world"
    path.write_text(json.dumps(content))
    sweep = read(world).sweep("epsilon_mini")
    assert sweep.tables == [] and "never mixes" in sweep.problem


def test_a_record_that_breaks_the_reading_is_listed_and_the_rest_is_there(world, monkeypatch):
    broken = epsilon("mini")
    broken.sweep.name = "other"
    write_record(record_path(world.reports, "other", "mini"), broken)
    original = board_module.sweep_tables

    def tables(record, results):
        if record.name == "other":
            raise AttributeError("no such thing")
        return original(record, results)

    monkeypatch.setattr(board_module, "sweep_tables", tables)
    board = read(world)
    assert [sweep.key for sweep in board.sweeps] == ["epsilon_mini"]
    assert board.broken["sweeps/other_mini.json"] == "AttributeError: no such thing"
    assert {key for run in board.runs.values() for key, _ in run.rows} == {"epsilon_mini"}


def test_a_file_that_breaks_its_reader_is_listed(world, monkeypatch):
    def read_any(path):
        raise KeyError(path.name)

    monkeypatch.setattr(board_module, "read_result", read_any)
    board = read(world)
    assert "not readable (KeyError" in board.broken[f"results/{world.run_id(0, 0)}.json"]
    assert [sweep.key for sweep in board.sweeps] == ["epsilon_mini"]


def test_files_that_are_not_read_are_listed(world, monkeypatch):
    """A link out of the reports, a pipe, a file too large: none is read, each is said, and the rest is there."""
    outside = world.outputs.parent / "outside.json"
    outside.write_text('{"s3cret": 1}')
    results = world.reports / "results"
    (results / "horizon3d-phase1-mini-0000beef.json").symlink_to(outside)
    (world.reports / "sweeps" / "link_mini.json").symlink_to(outside)
    (results / "inside.json").symlink_to(results / f"{world.run_id(0, 0)}.json")
    os.mkfifo(results / "pipe.json")
    with (results / "large.json").open("wb") as file:
        file.truncate(10**12)  # sparse: it takes no room
    opened = []
    original = board_module.read_result
    monkeypatch.setattr(board_module, "read_result", lambda path: opened.append(path.name) or original(path))
    board = read(world)
    assert "leads out" in board.broken["results/horizon3d-phase1-mini-0000beef.json"]
    assert "leads out" in board.broken["sweeps/link_mini.json"]
    assert "not a file" in board.broken["results/pipe.json"] and "bytes" in board.broken["results/large.json"]
    assert {"inside.json", f"{world.run_id(0, 0)}.json"} <= set(opened)
    assert not {"horizon3d-phase1-mini-0000beef.json", "pipe.json"} & set(opened)
    assert not any("s3cret" in said for said in board.broken.values())
    assert [sweep.key for sweep in board.sweeps] == ["epsilon_mini"]


def test_only_what_changed_is_read_again(world, monkeypatch):
    reads = []
    original = board_module.read_result
    monkeypatch.setattr(board_module, "read_result", lambda path: reads.append(path.name) or original(path))
    tables, build = [], board_module.sweep_tables
    monkeypatch.setattr(board_module, "sweep_tables", lambda *sources: tables.append(sources) or build(*sources))
    reader = BoardReader(world.reports, world.outputs)
    board, mark = reader.read()
    assert len(reads) == 7 and len(tables) == len(board.sweeps)
    assert reader.read() == (board, mark) and len(reads) == 7
    training = write_run(world.outputs, "horizon3d-phase2-mini-0000001a", 0, 0.3, 1.0)
    (training / "metrics.json").unlink()  # it still trains, and makes no table anew
    assert reader.read()[1] != mark and len(tables) == len(board.sweeps)
    before = len(tables)
    path = world.reports / "results" / f"{World.run_id(0, 0)}.json"
    path.write_text(path.read_text().replace('"seed": 0', '"seed": 7'))
    changed, new_mark = reader.read()
    assert reads[7:] == [path.name] and new_mark != mark
    assert changed.runs[World.run_id(0, 0)].seed == 7 and len(tables) == before + 1
    path.unlink()
    assert reader.read()[0].runs[World.run_id(0, 0)].result is None and len(tables) == before + 2


def test_nothing_at_all(tmp_path):
    board, _ = BoardReader(tmp_path / "reports", tmp_path / "outputs").read()
    assert (board.sweeps, board.runs, board.scales, board.has_reports) == ([], {}, [], False)
