import pytest
import torch

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
