"""Who may import whom (reads the imports, runs nothing)."""

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SRC = ROOT / "src"
FILES = sorted(SRC.rglob("*.py"))

ENTRY = {
    "train", "evaluate", "predict", "export", "replay", "streaming", "config", "assembly",
    "sweep", "study", "report", "gallery", "dashboard", "world", "benchmark",
}  # fmt: skip
"""Commands and what only they share: they may import everything."""

# room -> rooms it may import from
ALLOWED = {
    "errors": set(),
    "files": {"errors"},
    "geometry": {"errors"},
    "ops": {"errors", "geometry"},
    "structures": {"errors", "geometry", "ops"},
    "losses": {"errors", "ops", "structures"},
    "targets": {"errors", "geometry", "ops", "structures"},
    "models": {"errors", "geometry", "ops", "structures", "losses", "targets"},
    "data": {"errors", "files", "geometry", "structures"},
    "metrics": {"errors", "files", "geometry", "structures"},
    "pictures": {"errors", "files", "geometry", "structures"},
    "reliability": {"errors", "files", "geometry", "ops", "structures"},
    "training": {
        "errors", "files", "geometry", "ops", "structures", "losses", "targets", "models", "data", "metrics",
        "pictures", "reliability",
    },
}  # fmt: skip
LIGHT = ("report", "dashboard")
"""They read JSON and YAML: whatever they import, directly or not, is free of these (`make report` itself draws)."""
HEAVY = {"torch", "lightning", "hydra", "omegaconf", "matplotlib"}
FRAMEWORKS = {
    "lightning": ("training/", "reliability/", "data/datamodule.py", "train.py"),
    "hydra": ("config.py", "sweep/compose.py"),
    "omegaconf": ("config.py", "sweep/compose.py", "sweep/sweep_files.py"),
    "truckscenes": ("benchmark/suite_metric.py",),
}
"""Where a framework may be imported."""


def imports_of(path: Path) -> list[str]:
    """Modules a file imports, absolute names; `from src.a import b` counts as src.a.b where that is a module."""
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            inner = [f"{node.module}.{alias.name}" for alias in node.names]
            found += [name for name in inner if file_of(name)] or [node.module]
    return found


def file_of(module: str) -> Path | None:
    path = ROOT / Path(*module.split("."))
    return next((file for file in (path.with_suffix(".py"), path / "__init__.py") if file.is_file()), None)


def is_drawing(path: Path) -> bool:
    return path == SRC / "report" / "__main__.py"


def room_of(path: Path) -> str:
    return path.relative_to(SRC).parts[0].removesuffix(".py")


def test_imports_go_down_and_frameworks_stay_in_their_rooms():
    faults = []
    for path in FILES:
        room, place = room_of(path), str(path.relative_to(SRC))
        for module in imports_of(path):
            first, _, rest = module.partition(".")
            if first == "src" and rest and room not in ENTRY | {"__init__"}:
                target = rest.split(".")[0]
                if target != room and target not in ALLOWED[room]:
                    faults.append(f"{place} imports {module}")
            if first in FRAMEWORKS and not place.startswith(FRAMEWORKS[first]):
                faults.append(f"{place} imports {module}")
            family = module.split(".")[2] if module.startswith("src.models.") else None
            if family in FAMILIES and not place.startswith(f"models/{family}/") and place != "models/__init__.py":
                faults.append(f"{place} imports {module}: a family is named in the table of families alone")
    for room in LIGHT:
        faults += [f"src/{room} leads to {chain}" for chain in heavy_chains(room)]
    assert not faults, "\n".join(faults)


FAMILIES = {path.parent.name for path in SRC.glob("models/*/model.py")}


def heavy_chains(room: str) -> list[str]:
    """How files of a room come to import something heavy, `a -> b -> torch`."""
    waiting = [(path, str(path.relative_to(SRC))) for path in FILES if room_of(path) == room and not is_drawing(path)]
    seen, found = {path for path, _ in waiting}, []
    while waiting:
        path, chain = waiting.pop()
        for module in imports_of(path):
            if module.split(".")[0] in HEAVY:
                found.append(f"{chain} -> {module}")
            inner = file_of(module) if module.startswith("src") else None
            if inner is not None and inner not in seen:
                seen.add(inner)
                waiting.append((inner, f"{chain} -> {module}"))
    return found


def test_the_tree_keeps_its_promises():
    loads = [
        (path, node)
        for path in FILES
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.keyword) and node.arg == "weights_only"
    ]
    assert loads
    for path, node in loads:
        assert isinstance(node.value, ast.Constant) and node.value.value is True, f"{path} may load code"
    assert len(list(SRC.glob("*.py"))) <= 10
    names = [path.name for path in FILES if path.name not in ("__init__.py", "__main__.py", "model.py")]
    assert len(set(names)) == len(names), sorted({name for name in names if names.count(name) > 1})
    classes = [
        (node.name, path) for path in FILES for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    ]  # fmt: skip
    twice = {name for name, _ in classes if [other for other, _ in classes].count(name) > 1}
    assert not twice, twice
    rooms = ALLOWED.keys() | {"sweep", "study", "report", "gallery", "dashboard", "world", "benchmark"} - {"errors"}
    for room in rooms - {"errors"}:
        assert list((ROOT / "tests" / room).rglob("test_*.py")), f"tests/{room} is empty"
