"""Features and centres of some cells, worked by hand."""

import pytest
import torch

from src.geometry.bev_grid import BEVGrid
from src.ops.gather_cells import gather_cells

GRID = BEVGrid(cells=(4, 6), cell_m=2.0, centre_m=(3.0, 0.0), z_range_m=(-3.0, 5.0))  # x -3 to 9, y -4 to 4
INDICES = torch.tensor([[0, 0, 0], [0, 3, 5], [1, 1, 2]])
FEATURES = torch.tensor([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])


def test_cells_and_padding():
    centres, valid, found = gather_cells(FEATURES, INDICES, torch.tensor([[1, 0, -1], [2, -1, -1]]), GRID)
    assert valid.tolist() == [[True, True, False], [True, False, False]]
    assert found.tolist() == [[[3, 4], [1, 2], [0, 0]], [[5, 6], [0, 0], [0, 0]]]
    assert centres[valid].tolist() == [[8.0, 3.0], [-2.0, -3.0], [2.0, -1.0]]


@pytest.mark.parametrize("rows", [torch.zeros(2, 0).long(), torch.full((2, 3), -1)])
@pytest.mark.parametrize("count", [0, 3])
def test_nothing_is_gathered(count, rows):
    centres, valid, found = gather_cells(FEATURES[:count], INDICES[:count], rows, GRID)
    assert not valid.any() and not found.any() and centres.isfinite().all()
    assert centres.shape == found.shape == (*rows.shape, 2)


def test_gradients_of_a_cell_gathered_twice():
    features = FEATURES.double().requires_grad_()
    rows = torch.tensor([[1, 1, -1], [2, 1, 0]])
    assert torch.autograd.gradcheck(lambda x: gather_cells(x, INDICES, rows, GRID)[2], [features])
