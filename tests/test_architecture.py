"""Who may import whom (reads the imports, runs nothing)."""

import ast
from pathlib import Path

import pytest

SRC = Path(__file__).resolve().parent.parent / "src"
FILES = sorted(path for path in SRC.rglob("*.py"))
ENTRY = {
    "train", "evaluate", "world", "report", "benchmark", "predict", "export", "streaming", "assembly", "command",
    "config", "handoff", "sweep", "sweep_config", "dashboard", "replay",
}  # fmt: skip

# Suites of the benchmark: they may import what an entry point may, and only entry points import them.
FREE = {"benchmarking"}

# room -> rooms it may import from; entry points may import everything.
ALLOWED = {
    "errors": set(),
    "overrides": set(),
    "reporting": {"errors", "overrides", "structures"},  # of structures only the names of the classes: no torch
    "sweeping": {"errors", "overrides", "reporting"},
    "geometry": {"errors"},
    "ops": {"errors", "geometry"},
    "structures": {"errors", "geometry", "ops"},
    "losses": {"errors", "ops", "structures"},
    "targets": {"errors", "geometry", "ops", "structures"},
    "models": {"errors", "geometry", "ops", "structures", "losses", "targets"},
    "data": {"errors", "geometry", "structures"},
    "metrics": {"errors", "geometry", "structures"},
    "pictures": {"errors", "geometry", "structures"},
    "training": {
        "errors", "overrides", "geometry", "ops", "structures", "losses", "targets", "models", "data", "metrics",
        "pictures",
    },
}  # fmt: skip


def imports_of(path: Path) -> list[str]:
    """Modules a file imports, absolute names."""
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found.append(node.module)
    return found


def room_of(path: Path) -> str:
    return path.relative_to(SRC).parts[0].removesuffix(".py")


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(SRC)))
def test_imports_go_down(path):
    room = room_of(path)
    if room in ENTRY | FREE | {"__init__"}:
        return
    for module in imports_of(path):
        if module == "src" or not module.startswith("src."):
            continue
        target = module.split(".")[1]
        assert target == room or target in ALLOWED[room], f"{room} must not import {module}"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(SRC)))
def test_frameworks_stay_in_their_room(path):
    modules = {module.split(".")[0] for module in imports_of(path)}
    relative = path.relative_to(SRC)
    if "lightning" in modules:
        assert room_of(path) == "training" or str(relative) in ("data/datamodule.py", "train.py")
    if modules & {"hydra", "omegaconf"}:
        assert str(relative) in ("config.py", "sweep_config.py")
    if modules & {"truckscenes"}:
        assert str(relative) == "metrics/benchmark.py"


def test_checkpoints_are_never_loaded_with_code():
    loads = [
        (path, node)
        for path in FILES
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.keyword) and node.arg == "weights_only"
    ]
    assert loads
    for path, node in loads:
        assert isinstance(node.value, ast.Constant) and node.value.value is True, path


def test_every_room_has_its_tests():
    tests = Path(__file__).parent
    for room in (ALLOWED.keys() | FREE) - {"errors", "overrides"}:
        assert list((tests / room).rglob("test_*.py")), f"tests/{room} is empty"
