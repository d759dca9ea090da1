import pytest
import torch

from src.geometry.bev_grid import BEVGrid
from src.ops.cell_keys import cell_centres, cell_keys
from src.ops.sites import Sites

INF, NAN = float("inf"), float("nan")


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_points_by_hand(dtype):
    points = torch.tensor(
        [[0.0, 0.0], [0.9, 1.2], [3.99, 5.99], [4.0, 0.0], [-0.01, 1.0], [NAN, 1.0], [1.0, INF], [1, 1]]
    )
    valid = torch.tensor([True] * 7 + [False])
    shape = (2, 3, 4)
    found = cell_keys(points, torch.tensor([0, 1]), valid, (0.0, 0.0), (1.0, 2.0), shape, dtype, behind=2)
    sites = Sites(shape, found)
    cells = torch.tensor([[0, 0, 0], [0, 0, 0], [0, 2, 3]])
    assert found.tolist() == sites.keys_of(cells).tolist() + [sites.end] * 7


def test_a_sample_of_each_point_and_three_axes():
    points, samples = torch.tensor([[1.5, 0.5, 2.5], [0.5, 0.5, 0.5]]), torch.tensor([1, 2])
    found = cell_keys(points, samples, None, (0.0,) * 3, (1.0,) * 3, (2, 3, 4, 5), torch.float64)
    sites = Sites((2, 3, 4, 5), found)
    assert found.tolist() == [*sites.keys_of(torch.tensor([[1, 2, 0, 1]])).tolist(), sites.end]


def test_centres_by_hand():
    grid = BEVGrid(cells=(3, 4), cell_m=2.0, centre_m=(4.0, 3.0), z_range_m=(0.0, 1.0))
    cells = torch.tensor([[0, 0, 0], [1, 2, 1]])
    assert cell_centres(Sites((2, 3, 4), cells).keys_of(cells), grid).tolist() == [[1.0, 1.0], [3.0, 5.0]]
