import logging
import os

import numpy as np
import pytest

from src.data import cache
from src.data.cache import load_index
from tests.data.tiny_set import VERSION


def test_second_start_reads_the_cache(broken_tables, tmp_path, monkeypatch):
    first = load_index(broken_tables.root, VERSION, tmp_path / "cache")
    monkeypatch.setattr(cache, "build_index", lambda *_: pytest.fail("the tables were read again"))
    second = load_index(broken_tables.root, VERSION, tmp_path / "cache")
    for name, value in vars(first).items():
        np.testing.assert_array_equal(getattr(second, name), value)


def test_changed_tables_are_read_again(broken_tables, tmp_path):
    load_index(broken_tables.root, VERSION, tmp_path / "cache")
    broken_tables.edit("scene", 0, name="scene-renamed-0")
    assert "scene-renamed-0" in load_index(broken_tables.root, VERSION, tmp_path / "cache").scene_names


@pytest.mark.parametrize("damage", ["truncated", "flipped", "text", "pickle"])
def test_broken_cache_is_built_again(broken_tables, tmp_path, caplog, damage):
    folder = tmp_path / "cache"
    load_index(broken_tables.root, VERSION, folder)
    (file,) = folder.glob("*.npz")
    content = bytearray(file.read_bytes())
    if damage == "flipped":
        content[len(content) // 2] ^= 0xFF
    broken = {"truncated": content[: len(content) // 2], "text": b"hello", "flipped": content}.get(damage)
    if damage == "pickle":
        np.savez(file, scene_names=np.array([{"a": 1}], dtype=object), annotated=np.array(True))
    else:
        file.write_bytes(bytes(broken))
    assert len(load_index(broken_tables.root, VERSION, folder)) == 6
    assert "broken" in caplog.text
    caplog.clear()
    load_index(broken_tables.root, VERSION, folder)
    assert "broken" not in caplog.text


@pytest.mark.parametrize(
    "name, change",
    [
        ("frame_poses", lambda column: column + 10**6),
        ("key_data", lambda column: column.astype(float)),
        ("pose_times_us", lambda column: column.byteswap().view(column.dtype.newbyteorder())),
        ("box_sizes", lambda column: -column),
        ("box_centers", lambda column: column * np.nan),
        ("box_starts", lambda column: column[::-1]),
        ("data_times_us", lambda column: column[:-1]),
        ("ego_from_sensor", lambda column: column * 1e30),
    ],
)
def test_a_cache_that_a_stranger_wrote_is_built_again(broken_tables, tmp_path, caplog, name, change):
    """Whole to every checksum, with columns that do not fit each other."""
    whole = load_index(broken_tables.root, VERSION, tmp_path / "cache")
    (file,) = (tmp_path / "cache").glob("*.npz")
    with np.load(file) as arrays:
        columns = dict(arrays)
    np.savez(file, **(columns | {name: change(columns[name])}))
    again = load_index(broken_tables.root, VERSION, tmp_path / "cache")
    # Times are what sensor files are counted by: a cut there shows at the first column beside it.
    told = "data_scenes is [402] int32, expected [401]" if name == "data_times_us" else name
    assert "broken" in caplog.text and told in caplog.text
    np.testing.assert_array_equal(getattr(again, name), getattr(whole, name))


def test_a_cache_of_zeros_beyond_all_memory_is_built_again(broken_tables, tmp_path, caplog):
    load_index(broken_tables.root, VERSION, tmp_path / "cache")
    (file,) = (tmp_path / "cache").glob("*.npz")
    np.savez_compressed(file, annotated=np.array(True), box_labels=np.zeros(30_000_000, np.int8))
    assert len(load_index(broken_tables.root, VERSION, tmp_path / "cache")) == 6
    assert "larger than the file" in caplog.text


def test_cache_that_cannot_be_written_is_done_without(broken_tables, tmp_path, caplog, monkeypatch):
    monkeypatch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with caplog.at_level(logging.WARNING):
        assert len(load_index(broken_tables.root, VERSION, tmp_path / "cache")) == 6
    assert "No space left" in caplog.text and not list((tmp_path / "cache").iterdir())
