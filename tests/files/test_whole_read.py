import os

import pytest

from src.errors import DataError
from src.files.whole_read import read_whole


def test_a_file_of_the_longest_size_is_read_whole(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"0123456789")
    assert read_whole(path, 10) == b"0123456789" == read_whole(str(path), 10**9)
    with pytest.raises(DataError, match=r"a: at most 9 bytes are expected, but it has 10"):
        read_whole(path, 9)
    path.write_bytes(b"")
    assert read_whole(path, 0) == b""


def test_a_terabyte_is_refused_without_reading_it(tmp_path):
    with open(tmp_path / "sparse", "wb") as file:
        file.truncate(2**40)
    with pytest.raises(DataError, match="sparse: at most 1000 bytes"):
        read_whole(tmp_path / "sparse", 1000)


def test_what_is_no_file_is_refused_and_never_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for name in (tmp_path, tmp_path / "pipe", "/dev/zero"):
        with pytest.raises(DataError, match=f"{name}: must be a file"):
            read_whole(name, 1000)
    with pytest.raises(DataError, match="none: no such file"):
        read_whole(tmp_path / "none", 1000)
    with pytest.raises(DataError, match="cannot be read"):
        read_whole(f"{tmp_path}/a\0b", 1000)
    with pytest.raises(DataError, match="cannot be read"):
        read_whole(tmp_path / ("x" * 300), 1000)
