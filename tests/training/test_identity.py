"""Which overrides make another run, and which results of a checkpoint lie apart."""

import pytest

from src.config import compose_config
from src.training.identity import canonical, digest_of_changes, is_of, key_of, run_identity, without_keys


@pytest.mark.slow
def test_run_identity_ignores_what_cannot_change_the_result():
    def identity(*overrides):
        return run_identity(compose_config(["scale=debug", *overrides])[1])

    base = identity()
    assert base.startswith("horizon3d-phase1-debug-") and len(base.rsplit("-", 1)[1]) == 8
    same = ["paths.outputs=elsewhere", "logger=wandb", "data.num_workers=7", "resume=never", "trainer=cpu"]
    for override in same:
        assert identity(override) == base, override
    for override in ["seed=1", "optim.lr=1e-3", "model.ocsf.margin_m=0.8", "model.kggi.initialization=random"]:
        assert identity(override) != base, override


@pytest.mark.slow
def test_run_identity_of_phase_2():
    """Every knob of the memory makes another run; so do the weights it starts from, by what they are."""

    def identity(*overrides, source="horizon3d-phase1-debug-00000000"):
        return run_identity(compose_config(["scale=debug", "phase=phase2", *overrides])[1], source)

    base = identity()
    assert base.startswith("horizon3d-phase2-debug-")
    assert identity("phase.train_missing=false") == base == identity("phase.init_from=phase1", "resume=restart")
    assert identity("phase.init_from=some/where.ckpt") == base  # the digest of the weights counts, not the file's name
    assert identity(source="horizon3d-phase1-debug-11111111") != base
    for override in (
        "model.dptf.max_age_s=0.55",
        "model.dptf.bev_path=null",
        "model.dptf.gaussian_path.sampling=random",
        "model.dptf.gaussian_path.self_attention=null",
        "data.groups_per_scene=1",
        "data.sensor_dropout=0.5",
        "data.past_frames=2",
        "data.past_window_s=0.55",
        "phase.epochs=2",
    ):
        assert identity(override) != base, override


@pytest.mark.slow
def test_run_identity_of_phase_1_ignores_the_memory():
    def identity(*overrides):
        return run_identity(compose_config(["scale=debug", *overrides])[1])

    for override in ("model.dptf.max_age_s=0.55", "model.dptf=null", "data.groups_per_scene=1"):
        assert identity(override) == identity(), override


def test_what_changes_no_result_of_a_checkpoint_makes_no_other_place():
    where = [
        "checkpoint=a.ckpt",
        "out=b",
        "paths.outputs=c",
        "trainer.num_pictures=0",
        "trainer=cpu",
        "data.num_workers=0",
        "data.world.num_workers=2",
        "resume=auto",
        "phase.train_missing=false",
    ]
    assert digest_of_changes(where) == digest_of_changes(["scene=x"]) == ""
    changed = [
        digest_of_changes([*where, change])
        for change in ("data.root=d", "model.dptf.max_age_s=0.55", "data.split=test", "oracle=motion")
    ]
    assert len({"", *changed}) == 5
    pair = ["data.split=test", "data.root=d"]
    assert digest_of_changes(pair) == digest_of_changes(pair[::-1]) != ""


@pytest.mark.parametrize(
    ("spellings", "one"),
    [
        (("a.b=1e-4", "a.b=1.0e-4", "a.b=.0001", "a.b=1E-4"), "a.b=1.0e-4"),
        (("a=6e-5", "a=0.00006"), "a=6.0e-5"),
        (("a=1.5e-7", "a=0.00000015"), "a=1.5e-7"),
        (("a=0.00123", "a=1.23e-3"), "a=0.00123"),
        (("a=[-1.0,7]", "a=[-1,7.0]"), "a=[-1,7]"),
        (("a=1", "a=1.0", "a=1e0"), "a=1"),
    ],
)
def test_a_number_has_one_spelling(spellings, one):
    assert {canonical(spelling) for spelling in spellings} == {one}


@pytest.mark.parametrize(
    "text", ["a=horizon3d-phase2-mini-6e546620", "a=0-0.5", "a=v1.0-trainval", "a=1.2.3", "a=x1e5", "a=1e999"]
)
def test_digits_of_a_word_stay(text):
    assert canonical(text) == text


@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("optim.lr=2e-4", "optim.lr"),
        ("+model.x=a=b", "model.x"),
        ("++phase=phase1", "phase"),
        ("model.dptf", "model.dptf"),
    ],
)
def test_key_of(override, key):
    assert key_of(override) == key


def test_a_key_holds_what_is_below_it_and_nothing_that_only_begins_like_it():
    assert is_of("paths.outputs=/o", ("paths",)) and is_of("+trainer=cpu", ("resume", "trainer"))
    assert not is_of("pathsandmore=1", ("paths",)) and not is_of("data.roots=1", ("data.root",))
    assert not is_of("data=synthetic", ("data.root",))


def test_without_keys_copies_and_takes_missing_and_null_parts_as_they_are():
    tree = {"paths": {"outputs": "/o"}, "data": {"root": "/d", "world": None, "batch_size": 2}}
    assert without_keys(tree, ("paths", "data.root", "data.world.num_workers", "out")) == {
        "data": {"world": None, "batch_size": 2}
    }
    assert tree["data"]["root"] == "/d"
