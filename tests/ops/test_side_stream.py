"""Branches side by side: who waits for whom on a GPU."""

from types import SimpleNamespace

import pytest
import torch

from src.ops import side_stream
from src.ops.side_stream import on_side_stream


class Stream:
    """A stream of a GPU that notes for which it waits."""

    def __init__(self, name, notes):
        self.name, self.cuda_stream, self.notes = name, name, notes

    def wait_stream(self, other):
        self.notes.append(f"{self.name} waits for {other.name}")

    def __enter__(self):
        self.notes.append(f"on {self.name}")

    def __exit__(self, *error):
        self.notes.append(f"off {self.name}")


@pytest.fixture
def cuda(monkeypatch):
    notes = []
    streams = SimpleNamespace(main=Stream("main", notes), made=[])

    def made(device):
        streams.made.append(Stream(f"branch {len(streams.made)}", notes))
        return streams.made[-1]

    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: streams.main)
    monkeypatch.setattr(torch.cuda, "Stream", made)
    monkeypatch.setattr(torch.cuda, "stream", lambda stream: stream)
    side_stream._branch_of.cache_clear()
    with torch.no_grad():
        yield streams, notes
    side_stream._branch_of.cache_clear()


def test_a_branch_begins_behind_and_is_joined_by_its_stream(cuda):
    streams, notes = cuda
    with on_side_stream(torch.device("cuda", 0)) as join:
        notes.append("branch works")
    notes.append("main works")
    join()
    assert notes == [
        *("branch 0 waits for main", "on branch 0", "branch works", "off branch 0"),
        *("main works", "main waits for branch 0"),
    ]


def test_a_stream_keeps_its_branch_and_shares_it_with_none(cuda):
    streams, notes = cuda
    for name in ("main", "main", "other"):
        streams.main = Stream(name, notes)
        with on_side_stream(torch.device("cuda", 0)):
            pass
    assert len(streams.made) == 2


def test_neither_a_cpu_nor_training_has_branches(cuda):
    _, notes = cuda
    for device, training in (("cpu", False), ("cuda", True)):
        with torch.set_grad_enabled(training), on_side_stream(torch.device(device)) as join:
            notes.append("works")
        join()
    assert notes == ["works"] * 2


@pytest.mark.gpu
@torch.no_grad()
@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")
def test_results_of_a_branch_are_there_once_it_is_joined():
    values = torch.randn(2000, 2000, device="cuda")
    expected = values @ values
    for _ in range(20):
        with on_side_stream(values.device) as join:
            product = values @ values
        other = values.sin()
        join()
        torch.testing.assert_close(product + other, expected + other)
        del product
