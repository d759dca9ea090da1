"""The plan: what is trained, in which order, and by which command."""

import pytest

from src.errors import ConfigError
from src.report.sweep_record import suffix_of
from src.sweep.plan import changes_of, join_overrides, make_plan, split_machine, without_published
from tests.sweep.fake_sweep import make_sweep
from tests.sweep.fake_train import identify


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
    labels = [(spec.label, spec.seed) for spec in plan.specs.values()]
    assert labels == [("a", 3), ("b", 3), ("c", 3), ("a", 4), ("b", 4), ("c", 4)]
    first, second, *_ = plan.specs.values()
    assert first.overrides == ["phase=phase1", "model.x=2", "seed=3"] and first.needs is None
    assert second.overrides == ["phase=phase2", "model.x=2", "seed=3"] and second.needs == first.run_id
    assert plan.rows["b"] == plan.rows["b again"] and plan.labels(second.run_id) == ["b", "b again"]
    assert plan.changes == ["model.x=2"] and plan.study == f"fake-debug{suffix_of(plan.changes)}"


def test_a_setting_of_the_file_spelled_otherwise_is_no_change():
    sweep = make_sweep({"a": []}, overrides=["optim.lr=1.0e-4", "model.x=[1.0,2]"])
    assert make_plan(sweep, ["optim.lr=0.0001", "model.x=[1,2.0]"], [0], identify).changes == []
    assert make_plan(sweep, ["optim.lr=1e-3"], [0], identify).changes == ["optim.lr=1e-3"]


def test_a_value_of_the_file_that_a_row_says_otherwise_is_a_change():
    """The command line counts last, so it changes that row."""
    sweep = make_sweep({"a": [], "b": ["model.x=2"]}, overrides=["model.x=1"])
    assert make_plan(sweep, ["model.x=1"], [0], identify).changes == ["model.x=1"]
    assert (
        make_plan(make_sweep({"a": [], "b": []}, overrides=["model.x=1"]), ["model.x=1"], [0], identify).changes == []
    )


def test_rows_may_have_seeds_of_their_own():
    sweep = make_sweep({"a": ["phase=phase1"], "b": ["phase=phase2"], "c": ["model.x=1"]})
    plan = make_plan(sweep, [], {"a": [0], "b": range(2), "c": range(3)}, identify)
    assert {label: list(runs) for label, runs in plan.rows.items()} == {"a": [0], "b": [0, 1], "c": [0, 1, 2]}
    labels = [(spec.label, spec.seed) for spec in plan.specs.values()]
    assert labels == [("a", 0), ("b", 0), ("c", 0), ("weights for b", 1), ("b", 1), ("c", 1), ("c", 2)]
    assert plan.seeds == [0, 1, 2]


def test_a_run_that_no_row_shows_says_what_it_is_for():
    plan = make_plan(make_sweep({"b": ["phase=phase2"]}), ["paths.outputs=o"], [0], identify)
    first, second = plan.specs.values()
    assert first.label == "weights for b" and plan.labels(first.run_id) == [] and second.needs == first.run_id
    assert first.command == "python -m src.train phase=phase1 seed=0 paths.outputs=o"


def test_a_row_may_score_the_weights_of_another():
    """Of the same seed, trained first though it stands later; no matter what its own overrides would have trained."""
    sweep = make_sweep({"few": ["phase=phase2", "model.x=1"], "all": ["phase=phase2"]})
    sweep.rows[0].weights = "all"
    plan = make_plan(sweep, ["optim.lr=1"], [3, 4], identify)
    labels = [(spec.label, spec.seed) for spec in plan.specs.values()]
    assert labels == [(row, seed) for seed in (3, 4) for row in ("weights for all", "all", "few")]
    for seed in (3, 4):
        trained, scored = (plan.specs[plan.rows[row][seed]] for row in ("all", "few"))
        assert scored.needs == trained.run_id and trained.needs is not None
        own = {f"phase.init_from={trained.run_id}", "phase.epochs=0", "model.x=1", "optim.lr=1", f"seed={seed}"}
        assert set(scored.overrides) == own | {"phase=phase2"}
    rest = without_published(plan, {plan.rows["all"][3], plan.rows["all"][4], plan.rows["few"][4]})
    assert plan.rows["all"][3] not in rest.published and plan.rows["all"][4] in rest.published


def test_what_has_a_result_is_not_trained_nor_what_only_it_starts_from():
    rows = {"one": ["phase=phase1"], "two": ["phase=phase2"], "three": ["phase=phase2", "optim.lr=1"]}
    plan = make_plan(make_sweep(rows), [], [0], identify)
    one, two, three = (plan.rows[row][0] for row in rows)
    lr = plan.specs[three].needs
    assert list(plan.specs) == [one, lr, two, three]

    rest = without_published(plan, {two})
    assert list(rest.specs) == [one, lr, two, three] and rest.published == {two}
    rest = without_published(plan, {three})  # nothing else starts from the weights of that learning rate
    assert list(rest.specs) == [one, two, three] and rest.published == {three}
    rest = without_published(plan, {one, lr, three})  # the weights that row two starts from are not there
    assert list(rest.specs) == [one, two, three] and rest.published == {three}
    rest = without_published(plan, {one, two, three})
    assert list(rest.specs) == [one, two, three] and len(rest.published) == 3
    assert without_published(plan, set()) == plan


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


def test_what_a_command_line_changes_makes_another_experiment():
    sweep = make_sweep({"a": ["model.x=1"]}, overrides=["phase=phase1"])
    places = ["scale=debug", "seed=3", "paths.outputs=/o", "trainer=cpu", "logger=wandb", "data.num_workers=2"]
    assert make_plan(sweep, places, [0], identify).study == "fake-debug"
    assert changes_of(sweep, [*places, "phase=phase1"]) == []  # as the file says
    assert changes_of(sweep, ["phase=phase1", "optim.lr=1", "data=synthetic", "optim.lr=2"]) == [
        "data=synthetic",
        "optim.lr=2",
    ]
    names = {
        make_plan(sweep, [*places, *more], [0], identify).study
        for more in ([], ["optim.lr=1"], ["optim.lr=2"], ["optim.lr=2", "model.z=1"], ["model.z=1", "optim.lr=2"])
    }
    assert len(names) == 4 and all(name.startswith("fake-debug") for name in names)


def test_a_phase_other_than_the_files_is_refused():
    with pytest.raises(ConfigError, match="phase=phase2 contradicts phase=phase1 of sweeps/fake.yaml, overrides"):
        make_plan(make_sweep({"a": []}, overrides=["phase=phase1"]), ["phase=phase2"], [0], identify)
    rows = {"a": ["phase=phase2"], "b": ["phase=phase1"]}
    with pytest.raises(ConfigError, match="phase=phase2 contradicts phase=phase1 of sweeps/fake.yaml, row 'b'"):
        make_plan(make_sweep(rows), ["phase=phase2"], [0], identify)
    plan = make_plan(make_sweep({"a": ["model.x=1"]}), ["phase=phase2"], [0], identify)  # the file says none
    assert plan.changes == ["phase=phase2"]


def test_a_row_of_another_task_than_the_sweeps_is_refused():
    with pytest.raises(ConfigError, match="row 'a': phase.task=segmentation, but the sweep is of task detection"):
        make_plan(make_sweep({"a": ["phase.task=segmentation"]}), [], [0], identify)
