import math

import pytest
import torch

from src.errors import ConfigError
from src.geometry.bev_grid import BEVGrid

SMALL = BEVGrid(cells=(4, 6), cell_m=0.5, centre_m=(1.0, -2.0), z_range_m=(-3.0, 5.0))


def test_cells_and_centres_by_hand():
    assert (SMALL.rows, SMALL.cols, SMALL.x_min_m, SMALL.y_min_m) == (4, 6, -0.5, -3.0)
    assert SMALL.half_extent_m == (1.5, 1.0)
    xy = torch.tensor([[-0.5, -3.0], [0.1, -1.4], [2.49, -1.01]])
    assert SMALL.to_cells(xy[:2]).tolist() == [[0.0, 0.0], pytest.approx([1.2, 3.2])]
    assert SMALL.cell_of(xy).tolist() == [[0, 0], [3, 1], [3, 5]]
    assert SMALL.centre_of(SMALL.cell_of(xy[1:2])).tolist() == [[0.25, -1.25]]


def test_upper_edges_and_nan_lie_outside():
    points = torch.tensor([[2.5, -2.0], [1.0, -1.0], [-0.5, -3.0], [math.nan, -2.0]])
    assert SMALL.contains(points).tolist() == [False, False, True, False]
    low_and_high = torch.tensor([-3.0, 4.9, 5.0, math.nan])
    inside = torch.cat([points[2].expand(4, 2), low_and_high[:, None]], 1)
    assert SMALL.contains_points(inside).tolist() == [True, True, False, False]
    assert not SMALL.contains_points(torch.tensor([2.5, -2.0, 0.0]))


def test_keys_count_cells_of_all_samples_row_by_row():
    cells = torch.tensor([[0, 0], [0, 5], [1, 0], [3, 5]])
    assert SMALL.keys_of(torch.tensor([0, 0, 1, 2]), cells).tolist() == [0, 5, 24 + 6, 48 + 23]


@pytest.mark.parametrize(
    "change", [{"cells": (0, 4)}, {"cell_m": 0.0}, {"centre_m": (math.inf, 0.0)}, {"z_range_m": (2.0, 2.0)}]
)
def test_impossible_grids_are_refused(change):
    values = {"cells": (4, 4), "cell_m": 0.8, "centre_m": (0.0, 0.0), "z_range_m": (-3.0, 5.0)} | change
    with pytest.raises(ConfigError, match=f"grid.{next(iter(change))}="):
        BEVGrid(**values)
