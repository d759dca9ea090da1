"""Every promise of docs/reliability.md names a test that exists; the room names the Lightning it is written for."""

import ast
import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from src import reliability

ROOT = Path(__file__).resolve().parents[2]


def promised_tests():
    """(file, function) of every test in the tables; `::name` alone is of the file named before it in its row."""
    named = []
    for line in (ROOT / "docs" / "reliability.md").read_text().splitlines():
        file = ""
        for path, name in re.findall(r"`((?:tests/[\w/]+\.py)?)::(\w+)`", line):
            file = path or file
            named.append((file, name))
    return named


def functions_of(file):
    path = ROOT / file
    tree = ast.parse(path.read_text() if path.is_file() else "")
    return {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}


@pytest.mark.slow
def test_every_promise_names_a_test_that_exists():
    named = promised_tests()
    assert len(named) > 30
    assert not [f"{file}::{name}" for file, name in named if name not in functions_of(file)]


def test_every_row_of_a_table_names_a_test():
    rows = [line for line in (ROOT / "docs" / "reliability.md").read_text().splitlines() if line.startswith("| ")]
    assert not [row for row in rows if "::" not in row and row != "| fault | what happens | test |"]


def test_the_room_names_the_one_lightning_that_it_is_pinned_to():
    (version,) = re.findall(r"Pinned to Lightning (\d+\.\d+) ", reliability.__doc__)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    (bound,) = [wanted for wanted in map(Requirement, project["dependencies"]) if wanted.name == "lightning"]
    major, minor = map(int, version.split("."))
    assert f"{version}.99" in bound.specifier
    assert f"{major}.{minor - 1}.99" not in bound.specifier and f"{major}.{minor + 1}.0" not in bound.specifier
