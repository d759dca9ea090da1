"""Made-up experiments, on disk and served."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from src.dashboard.board import Board, BoardReader
from tests.dashboard.experiments import World, build, serve


@pytest.fixture
def world(tmp_path: Path) -> World:
    """A world of the test's own."""
    return build(tmp_path)


@pytest.fixture(scope="module")
def shared_world(tmp_path_factory: pytest.TempPathFactory) -> World:
    """A world that tests only read."""
    return build(tmp_path_factory.mktemp("world"))


@pytest.fixture(scope="module")
def served(shared_world: World) -> Iterator[str]:
    """Address of a live dashboard over the shared world."""
    yield from serve(shared_world)


@pytest.fixture
def board(shared_world: World) -> Board:
    """What it shows."""
    return BoardReader(shared_world.reports, shared_world.outputs).read()[0]
