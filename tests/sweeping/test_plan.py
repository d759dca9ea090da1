"""The plan: what is trained, in which order, and by which command."""

import pytest

from src.errors import ConfigError
from src.sweeping.plan import join_overrides, make_plan, split_machine
from tests.sweeping.fake_sweep import make_sweep
from tests.sweeping.fake_train import identify


def test_the_later_override_wins_and_stands_once():
    assert join_overrides(["phase=phase1", "model.x=1"], ["phase=phase2"], ["+model.x=2"]) == [
        "phase=phase2",
        "+model.x=2",
    ]
    order = join_overrides(["model.a=null"], ["model.a.b=1"], ["model.a=null"])
    assert order == ["model.a.b=1", "model.a=null"]


def test_what_a_machine_needs_is_no_part_of_a_run():
    overrides = ["paths.outputs=/o", "model.x=1", "trainer=cpu", "trainer.devices=2", "data.num_workers=1", "data.x=1"]
    overrides += ["data.root=/d", "phase.train_missing=false", "phase=phase1", "resume=restart", "logger=wandb"]
    what, machine = split_machine(overrides)
    assert what == ["model.x=1", "data.x=1", "phase=phase1"] and len(what) + len(machine) == len(overrides)


def test_order_is_seed_by_seed_and_first_what_others_start_from():
    rows = {
        "b": ["phase=phase2"],
        "a": ["phase=phase1"],
        "c": ["phase=phase2", "model.dptf=null"],
        "b again": ["phase=phase2"],
    }
    plan = make_plan(make_sweep(rows, overrides=["model.x=1"]), ["model.x=2"], [3, 4], identify)
    labels = [(cell.label, cell.seed) for cell in plan.cells.values()]
    assert labels == [("a", 3), ("b", 3), ("c", 3), ("a", 4), ("b", 4), ("c", 4)]
    first, second, *_ = plan.cells.values()
    assert first.overrides == ["phase=phase1", "model.x=2", "seed=3"] and first.needs is None
    assert second.overrides == ["model.x=2", "phase=phase2", "seed=3"] or second.needs == first.run_id
    assert plan.rows["b"] == plan.rows["b again"] and plan.labels(second.run_id) == ["b", "b again"]
    assert plan.study == "fake-debug"


def test_a_run_that_no_row_shows_says_what_it_is_for():
    plan = make_plan(make_sweep({"b": ["phase=phase2"]}), ["paths.outputs=o"], [0], identify)
    first, second = plan.cells.values()
    assert first.label == "weights for b" and plan.labels(first.run_id) == [] and second.needs == first.run_id
    assert first.command == "python -m src.train phase=phase1 seed=0 paths.outputs=o"


def test_a_row_that_does_not_compose_is_named_with_its_file():
    with pytest.raises(ConfigError, match=r"sweeps/fake.yaml, row 'b': optmi.lr is not a configuration key"):
        make_plan(make_sweep({"a": [], "b": ["optmi.lr=1"]}), [], [0], identify)
    with pytest.raises(ConfigError, match=r"sweeps/fake.yaml, overrides: optmi.lr"):
        make_plan(make_sweep({"a": []}, overrides=["optmi.lr=1"]), [], [0], identify)
    with pytest.raises(ConfigError, match=r"^optmi.lr"):  # the command line's own fault
        make_plan(make_sweep({"a": []}), ["optmi.lr=1"], [0], identify)


def test_a_sweep_is_of_one_scale():
    with pytest.raises(ConfigError, match="row 'b': scale=mini, but the sweep is of scale debug"):
        make_plan(make_sweep({"a": [], "b": ["scale=mini"]}), [], [0], lambda o: identify(o))
    sweep = make_sweep({"a": [], "b": ["model.x=1"]})
    sweep.rows[1].scales = ["paper"]
    plan = make_plan(sweep, [], [0], identify)
    assert list(plan.rows) == ["a"] and [row.label for row in plan.sweep.paper_rows] == ["b"]
