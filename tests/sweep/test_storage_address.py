"""Addresses of databases: which are refused unseen, and folders of any name."""

from pathlib import Path

import pytest

from src.errors import ConfigError
from src.sweep.storage_address import check_address, default_storage
from src.sweep.sweep_study import SweepStudy

ROWS = {"format": 1, "kind": "rows"}


def test_an_address_that_would_be_read_wrongly_is_refused_unseen():
    with pytest.raises(ConfigError, match="write @ as %40") as caught:
        check_address("postgresql://me:s3@cret@host/db")
    assert "s3" not in str(caught.value) and "cret" not in str(caught.value)
    check_address("sqlite:////a@b/c@d.db")
    check_address("postgresql://me:s3%40cret@host/db")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["{x}", "50%20off", "a?b", "a#b @:c", "{SCHEMA_VERSION}"])
def test_any_folder_can_hold_the_database(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    outputs = Path(name)
    SweepStudy(outputs, "fake-debug", default_storage(outputs), ROWS)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (outputs / "sweeps" / "sweeps.db").stat().st_size > 0


def test_the_default_address_is_as_relative_as_the_folder():
    assert default_storage(Path("outputs")) == "sqlite:///outputs/sweeps/sweeps.db"
    assert default_storage(Path("/o")) == "sqlite:////o/sweeps/sweeps.db"


@pytest.mark.parametrize("url", ["nosuch://me:s3{cret}@h/db", "nosuch://me:{s3cret@h/db", "nosuch://me:{0}s3cret@h/db"])
def test_braces_in_a_password_are_part_of_it_and_not_shown(tmp_path, url):
    with pytest.raises(ConfigError, match="cannot be used") as caught:
        SweepStudy(tmp_path, "x", url, ROWS)
    assert "cret" not in str(caught.value) and "nosuch" in str(caught.value)
