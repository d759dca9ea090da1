"""The pinned versions: complete, within the bounds of pyproject.toml, from no particular place, and used."""

import re
import subprocess
import tomllib
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

import pytest
from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]
WANTED = [
    Requirement(line) for line in [*PROJECT["dependencies"], *(line for lines in EXTRAS.values() for line in lines)]
]
BROUGHT_BY_TORCH = re.compile(r"nvidia-|cuda-|pytorch-triton|intel-|mkl")
"""Which of them depends on the build of torch."""


def pinned():
    """Requirements of the file by name; a comment ends a line."""
    lines = [line.partition("#")[0].strip() for line in (ROOT / "constraints.txt").read_text().splitlines()]
    found = [Requirement(line) for line in lines if line]
    assert len({canonicalize_name(one.name) for one in found}) == len(found), "a name stands twice"
    return {canonicalize_name(one.name): one for one in found}


def version_of(pin):
    (only,) = pin.specifier
    return only.version


def test_every_line_is_a_name_and_one_public_version():
    text = (ROOT / "constraints.txt").read_text()
    assert "://" not in text and "@" not in text and not re.search(r"^-", text, re.MULTILINE)
    for name, pin in pinned().items():
        (only,) = pin.specifier
        assert only.operator == "==" and not pin.url and not pin.extras, name
        assert "+" not in only.version and "*" not in only.version, name
    assert sorted(pinned()) == list(pinned())


@pytest.mark.parametrize("wanted", WANTED, ids=str)
def test_every_dependency_is_pinned_within_its_bounds(wanted):
    pin = pinned().get(canonicalize_name(wanted.name))
    assert pin is not None, f"{wanted.name} is not in constraints.txt"
    assert wanted.specifier.contains(version_of(pin), prereleases=True), (str(wanted), str(pin))
    if pin.marker is not None:  # then it holds wherever the dependency does
        assert wanted.marker is not None
        for system, machine, python in (
            ("linux", "x86_64", "3.11"),
            ("linux", "aarch64", "3.13"),
            ("darwin", "arm64", "3.12"),
        ):
            there = default_environment() | {
                "sys_platform": system, "platform_machine": machine, "python_version": python,
                "python_full_version": f"{python}.0",
            }  # fmt: skip
            assert pin.marker.evaluate(there) or not wanted.marker.evaluate(there)


def test_what_dependencies_need_is_pinned_too():
    """As far as it is installed here: what a package asks for by its own metadata, and so on."""
    pins, seen, to_do = pinned(), set(), list(WANTED)
    while to_do:
        one = to_do.pop()
        name = canonicalize_name(one.name)
        key = (name, frozenset(one.extras))
        if key in seen or BROUGHT_BY_TORCH.match(name):
            continue
        seen.add(key)
        assert name in pins, f"{name} is not in constraints.txt"
        try:
            needs = requires(name) or []
        except PackageNotFoundError:  # of an extra that is not installed here
            continue
        for need in map(Requirement, needs):
            extras = one.extras or {""}
            if need.marker is None or any(need.marker.evaluate({"extra": extra}) for extra in extras):
                to_do.append(need)
    assert len(seen) > 60


def test_an_install_from_scratch_takes_them_and_an_environment_of_ones_own_does_not():
    command = ["make", "--always-make", "--dry-run", "install"]
    bare = {"PATH": "/usr/bin:/bin:/usr/local/bin"}
    told = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=bare, timeout=60)
    assert "--constraint constraints.txt" in told.stdout, told.stderr
    told = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, env=bare | {"VIRTUAL_ENV": "/x"}, timeout=60
    )
    assert "pip install" in told.stdout and "constraints" not in told.stdout
    checks = (ROOT / ".ci" / "run").read_text()
    assert "make test" in checks and "unset VIRTUAL_ENV CONDA_PREFIX" in checks
