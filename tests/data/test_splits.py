import json

import pytest

from src.data.cache import load_index
from src.data.splits import OFFICIAL_LISTS, split_samples
from src.errors import DataError
from tests.data.tiny_set import VERSION


def test_own_split_file_wins(data_set):
    index = load_index(data_set.root, VERSION, None)
    assert split_samples(index, "train").tolist() == [0, 1, 2]
    assert split_samples(index, "val").tolist() == [3, 4, 5]
    with pytest.raises(DataError, match=r"split 'test'.*\['train', 'val'\]"):
        split_samples(index, "test")


def test_bad_split_files(broken_tables):
    index = load_index(broken_tables.root, VERSION, None)
    path = broken_tables.root / "splits.json"
    for text, words in (
        ("{", "JSON"),
        ("[" * 100_000, "JSON"),
        ('["train"]', "scene names"),
        ('{"train": []}', "'train' of .*splits.json has no scene"),
        ('{"train": ["no-such-scene"]}', "none of its 1"),
    ):
        path.write_text(text)
        with pytest.raises(DataError, match=words):
            split_samples(index, "train")


def test_official_lists():
    lists = json.loads(OFFICIAL_LISTS.read_text())
    counts = {name: len(set(scenes)) for name, scenes in lists["splits"].items()}
    assert counts == {"train": 523, "val": 75, "test": 149, "mini_train": 8, "mini_val": 2}
    assert "Apache-2.0" in lists["source"]
    devkit = pytest.importorskip("truckscenes.utils.splits", reason="devkit not installed")
    official = devkit.create_splits_scenes()
    assert {name: sorted(official[name]) for name in counts} == {n: sorted(s) for n, s in lists["splits"].items()}


def test_official_splits_follow_the_release(broken_tables):
    (broken_tables.root / "splits.json").unlink()
    scene = json.loads(OFFICIAL_LISTS.read_text())["splits"]["val"][0]
    broken_tables.edit("scene", 1, name=scene)
    index = load_index(broken_tables.root, VERSION, None)
    assert split_samples(index, "val").tolist() == [3, 4, 5]
    with pytest.raises(DataError, match=r"'mini_val'.*\['train', 'val'\]"):
        split_samples(index, "mini_val")
