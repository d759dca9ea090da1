"""Where a CUDA graph is captured: on the device of the detector, whichever is the current one."""

from contextlib import contextmanager
from types import SimpleNamespace

import pytest
import torch

from src.models.deploy.static_parts import WARM_UP_RUNS, capture_graph

DEVICE = torch.device("cuda:1")


@pytest.fixture
def notes(monkeypatch):
    """What happens in turn; streams are called by their device."""
    happened = []

    @contextmanager
    def within(name):
        happened.append(name)
        yield
        happened.append(f"end of {name}")

    def stream_of(kind):
        def make(device):
            wait = lambda one: happened.append(f"wait for {one.name}")  # noqa: E731
            return SimpleNamespace(name=f"{kind} of {device}", wait_stream=wait)

        return make

    for name, fake in {
        "device": lambda device: within(f"{device}"),
        "Stream": stream_of("side"),
        "current_stream": stream_of("main"),
        "CUDAGraph": lambda: "the graph",
        "stream": lambda stream: within(stream.name),
        "graph": lambda graph, stream: within(f"{graph} in {stream.name}"),
    }.items():
        monkeypatch.setattr(torch.cuda, name, fake)
    return happened


def test_everything_is_of_the_detectors_device(notes):
    graph, result = capture_graph(lambda: notes.append("step") or 7, DEVICE, lambda: notes.append("restored"))
    assert (graph, result) == ("the graph", 7)
    side, main = "side of cuda:1", "main of cuda:1"
    warm_up = [side, *["step"] * WARM_UP_RUNS, f"end of {side}"]
    capture = [f"the graph in {side}", "step", f"end of the graph in {side}"]
    assert notes == ["cuda:1", f"wait for {main}", *warm_up, f"wait for {side}", "restored", *capture, "end of cuda:1"]


def test_what_a_failed_warm_up_has_changed_is_undone(notes):
    def fail():
        raise RuntimeError("no memory")

    with pytest.raises(RuntimeError, match="no memory"):
        capture_graph(fail, DEVICE, lambda: notes.append("restored"))
    assert notes[-1] == "restored"
