import sys

import pytest
import torch

from src.errors import ConfigError
from src.ops import Sites, backend, sparse_conv, submanifold_map


@pytest.fixture
def doubled(monkeypatch):
    """A second backend that implements one operation."""
    table = {name: dict(choices) for name, choices in backend._implementations.items()}
    monkeypatch.setattr(backend, "_implementations", table)
    monkeypatch.setattr(backend, "_chosen", backend.REFERENCE)
    reference = backend.implementation("sparse_conv")
    backend.register("sparse_conv", "doubled")(lambda *arguments: 2 * reference(*arguments))


def test_the_chosen_backend_runs_and_the_rest_falls_back(doubled):
    kernel_map = submanifold_map(Sites.from_linear(torch.tensor([0, 1]), (1, 2, 2)), 3)
    arguments = (torch.ones(2, 1), torch.ones(9, 1, 1), kernel_map)
    assert sparse_conv(*arguments).tolist() == [[2.0], [2.0]]
    splat = backend.implementation("splat")
    backend.use("doubled")
    assert backend.chosen() == "doubled"
    assert sparse_conv(*arguments).tolist() == [[4.0], [4.0]]
    assert backend.implementation("splat") is splat


def test_unknown_backends_are_refused_with_the_choices(doubled):
    with pytest.raises(ValueError, match="'fast': expected one of doubled, reference"):
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
    assert ("triton" in backend.available()) == (obstacle is None)


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
    for operation in backend.KERNELS["triton"]:
        assert backend.implementation(operation, "reference").__name__.endswith("_reference")
