"""What overrides set, and which say nothing of what a run is."""

import pytest

from src.training.identity import is_of, key_of, without_keys


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
