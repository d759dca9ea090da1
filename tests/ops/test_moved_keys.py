import torch

from src.ops.moved_keys import NONE, moved_keys
from src.ops.sites import HALO, Sites


def test_by_hand():
    """Rows halved, columns moved: 2 x 3 cells of a grid of 4 x 3 onto one of 2 x 3."""
    sites = Sites.from_indices(torch.tensor([[1, 0, 0], [1, 2, 1], [1, 3, 1], [1, 2, 2]]), (2, 4, 3))[0]
    target = Sites((2, 2, 3), sites.keys)
    steps = ((sites.strides[1], 4 + HALO, 1, 2, 0, 2, target.strides[1]), (1, 3 + HALO, 1, 1, 0, 3, 1))
    found = moved_keys(sites.keys, (sites.strides[0], target.strides[0]), steps, ((0, 1), (-1, 0)))
    cells = torch.tensor([[1, 0, 1], [1, 1, 2], [1, 1, 1]])
    first, second, third = target.keys_of(cells).tolist()
    assert found.tolist() == [[first, second, NONE, NONE], [NONE, NONE, NONE, third]]


def test_no_sites():
    found = moved_keys(torch.zeros(0).long(), (5, 5), ((1, 5, 1, 1, 0, 3, 1),), ((0,), (1,)))
    assert found.shape == (2, 0) and found.dtype == torch.int64
