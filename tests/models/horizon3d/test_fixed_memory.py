"""The memory of fixed shapes holds what the other does, through every way there and back."""

import pytest
import torch

from src.models.horizon3d.dptf_memory import DPTFFrame, DPTFMemory, StoredCells
from src.models.horizon3d.fixed_memory import FixedMemory
from src.structures.gaussians import GaussianSet
from src.structures.taxonomy import Source


class Path:
    """What the memory asks of a path."""

    def __init__(self, **config):
        self.config = type("Config", (), config)


@pytest.fixture
def dptf():
    paths = {
        "config": type("Config", (), {"num_frames": 3}),
        "bev_path": Path(num_frames=3, max_cells_per_frame=6),
        "gaussian_path": Path(num_frames=1, gaussians_per_frame=2),
    }
    return type("Paths", (), paths)


def frame(time_s, num_cells, with_gaussians):
    draw = torch.Generator().manual_seed(num_cells)
    cells = StoredCells(
        *(torch.randn(num_cells, width, generator=draw) for width in (2, 2, 4)), torch.zeros(num_cells).long()
    )
    gaussians = None
    if with_gaussians:
        pairs = [torch.randn(1, 2, 2, generator=draw) for _ in range(4)]
        single = torch.randn(1, 2, generator=draw)
        valid = torch.tensor([[True, False]])
        gaussians = GaussianSet(
            *pairs[:3], single, pairs[3], torch.randn(1, 2, 4, generator=draw),
            torch.full((1, 2), int(Source.HISTORY)), torch.zeros(1, 2), valid,
        )  # fmt: skip
    pose = torch.eye(4, dtype=torch.float64)[None] * time_s
    return DPTFFrame(torch.tensor([time_s], dtype=torch.float64), pose, torch.tensor([True]), cells, gaussians)


def test_there_and_back(dptf):
    memory = DPTFMemory((frame(2.0, 5, True), frame(1.0, 0, False)))
    fixed = FixedMemory.of(memory, dptf, 4, torch.device("cpu"))
    assert [tuple(tensor.shape) for tensor in fixed.tensors] == [(3, 20), (3, 6, 9), (1, 2, 14)]
    back = fixed.to_memory()
    assert len(back.frames) == 2
    for mine, wanted in zip(back.frames, memory.frames, strict=True):
        assert len(mine.tensors()) == len(wanted.tensors())
        assert all(torch.equal(*pair) for pair in zip(mine.tensors(), wanted.tensors(), strict=True))


def test_a_memory_from_elsewhere_comes_to_the_device(dptf):
    there = torch.device("meta")
    fixed = FixedMemory.of(DPTFMemory((frame(2.0, 5, True),)), dptf, 4, there)
    assert {tensor.device for tensor in fixed.tensors} == {there}


def test_nothing_is_nothing(dptf):
    empty = FixedMemory.empty(dptf, 4, torch.device("cpu"))
    assert not empty.to_memory().frames
    assert all(torch.equal(*pair) for pair in zip(
        empty.tensors, FixedMemory.of(DPTFMemory(()), dptf, 4, torch.device("cpu")).tensors, strict=True
    ))  # fmt: skip
