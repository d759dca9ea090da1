"""The tiny data set, intact and as copies to break."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.data.tiny_set import VERSION, DataSet, write_data_set


@pytest.fixture(scope="session")
def data_set(tmp_path_factory: pytest.TempPathFactory) -> DataSet:
    """The intact data set; tests must not change it."""
    root = tmp_path_factory.mktemp("truckscenes")
    write_data_set(root)
    return DataSet(root)


@pytest.fixture(scope="session")
def lidar_set(tmp_path_factory: pytest.TempPathFactory) -> DataSet:
    """The intact data set with the sweeps of two LiDARs; tests must not change it."""
    root = tmp_path_factory.mktemp("truckscenes-lidar")
    write_data_set(root, lidar=True)
    return DataSet(root)


@pytest.fixture
def broken_lidar(lidar_set: DataSet, tmp_path: Path) -> DataSet:
    """A copy of it."""
    shutil.copytree(lidar_set.root, tmp_path, dirs_exist_ok=True)
    return DataSet(tmp_path)


@pytest.fixture
def broken_tables(data_set: DataSet, tmp_path: Path) -> DataSet:
    """A copy of the tables alone."""
    shutil.copytree(data_set.root / VERSION, tmp_path / VERSION)
    shutil.copy(data_set.root / "splits.json", tmp_path)
    return DataSet(tmp_path)


@pytest.fixture
def broken_files(data_set: DataSet, tmp_path: Path) -> DataSet:
    """A copy of tables and sensor files."""
    shutil.copytree(data_set.root, tmp_path, dirs_exist_ok=True)
    return DataSet(tmp_path)
