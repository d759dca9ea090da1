import re
import sys
import types
from pathlib import Path

import pytest
import torch

from src.errors import ConfigError
from src.ops import backend
from src.ops.kernel_maps import submanifold_map
from src.ops.sites import Sites
from src.ops.sparse_conv import sparse_conv, sparse_conv_reference


def test_the_chosen_backend_runs(undecided):
    kernel_map = submanifold_map(Sites.from_linear(torch.tensor([0, 1]), (1, 2, 2)), 3)
    arguments = (torch.ones(2, 1), torch.ones(9, 1, 1), kernel_map)
    kernels = types.ModuleType("src.ops.kernels.sparse_conv_triton")
    kernels.sparse_conv_triton = lambda *arguments: 2 * sparse_conv_reference(*arguments)
    undecided.setitem(sys.modules, kernels.__name__, kernels)
    for name, expected in (("reference", 2.0), ("triton", 4.0)):
        undecided.setattr(backend, "_triton_obstacle", lambda: None)
        backend.use(name)
        assert backend.chosen() == name and sparse_conv(*arguments).tolist() == [[expected]] * 2


def test_unknown_backends_are_refused_with_the_choices(undecided):
    backend.use("reference")
    with pytest.raises(ConfigError, match="fast: expected reference or triton"):
        backend.use("fast")
    assert backend.chosen() == "reference"


@pytest.fixture
def undecided(monkeypatch):
    """A process in which no operation has run yet."""
    monkeypatch.setattr(backend, "_chosen", None)
    monkeypatch.delenv("HORIZON3D_OPS", raising=False)
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    return monkeypatch


@pytest.mark.parametrize("cuda", [False, True])
@pytest.mark.parametrize("obstacle", [None, "Triton cannot be imported (reason)"])
def test_triton_is_the_choice_where_it_can_run(undecided, cuda, obstacle):
    undecided.setattr(torch.cuda, "is_available", lambda: cuda)
    undecided.setattr(backend, "_triton_obstacle", lambda: obstacle)
    assert backend.chosen() == ("triton" if cuda and obstacle is None else "reference")


def test_the_environment_overrides_and_the_first_call_decides(undecided):
    undecided.setattr(torch.cuda, "is_available", lambda: True)
    undecided.setattr(backend, "_triton_obstacle", lambda: None)
    undecided.setenv("HORIZON3D_OPS", "reference")
    assert backend.chosen() == "reference"
    undecided.setenv("HORIZON3D_OPS", "triton")
    assert backend.chosen() == "reference"


def test_a_wrong_environment_is_named(undecided):
    undecided.setattr(torch.cuda, "is_available", lambda: False)
    undecided.setenv("HORIZON3D_OPS", "cuda")
    with pytest.raises(ConfigError, match="HORIZON3D_OPS=cuda: expected reference or triton"):
        backend.chosen()
    undecided.setenv("HORIZON3D_OPS", "triton")
    with pytest.raises(ConfigError, match="there is no CUDA device.*HORIZON3D_OPS=reference"):
        backend.chosen()
    undecided.setenv("TRITON_INTERPRET", "1")
    undecided.setitem(sys.modules, "triton", None)  # as if it were not installed
    with pytest.raises(ConfigError, match="Triton cannot be imported"):
        backend.chosen()


def test_kernels_take_tensors_of_a_gpu_and_others_only_through_the_interpreter(undecided):
    assert not backend.runs_kernels(torch.ones(1))
    undecided.setenv("TRITON_INTERPRET", "1")
    assert backend.runs_kernels(torch.ones(1))


def test_every_kernel_belongs_to_an_operation_with_a_reference():
    folder, operations = Path(backend.__file__).parent, 0
    for path in folder.glob("kernels/*_triton.py"):
        kernels, plain = path.read_text(), folder / f"{path.stem.removesuffix('_triton')}.py"
        for operation in re.findall(r"^def (\w+)_triton\(", kernels, re.MULTILINE):
            assert f"{operation}_reference" in kernels and f"def {operation}_reference(" in plain.read_text()
            operations += 1
    assert operations > 30
