import math

import pytest
import torch

from src.config import compose_config
from src.errors import ConfigError
from src.geometry.bounds import farthest_m
from src.geometry.voxel_grid import VoxelGrid

GRID = VoxelGrid((-8.0, -4.0, -2.0), (24.0, 4.0, 2.0), (0.5, 0.25, 0.125), num_levels=3)


def preset(name):
    overrides = ["model=lrs4fusion", "phase=lrs_detection", "scale=paper", f"model/roi={name}", "data=truckscenes"]
    return compose_config([*overrides, "data.root=."])[0].model.roi.build(5)


def test_cells_follow_from_region_and_voxel():
    assert GRID.cells == (32, 32, 64)
    assert [GRID.at(level).cells for level in range(3)] == [(32, 32, 64), (16, 16, 32), (8, 8, 16)]
    assert GRID.at(2).voxel_m == (2.0, 1.0, 0.5) and GRID.at(1).at(1) == GRID.at(2)


@pytest.mark.parametrize(
    ("name", "cells", "farthest", "columns", "cell_m"),
    [
        ("roi_lrs", (64, 1024, 1792), 269.5, (128, 224), 1.5625),
        ("roi_official", (64, 1536, 1536), 217.6, (192, 192), 1.6),
    ],
)
def test_the_presets_are_those_of_the_specification(name, cells, farthest, columns, cell_m):
    grid = preset(name)
    assert grid.cells == cells
    assert round(farthest_m(tuple(zip(grid.lower_m, grid.upper_m, strict=True))), 1) == farthest
    bev = grid.at(3).bev()
    assert bev.cells == columns and math.isclose(bev.cell_m, cell_m)
    assert (bev.x_min_m, bev.y_min_m, *bev.z_range_m) == pytest.approx((*grid.lower_m[:2], -12.0, 12.0))


def test_points_cells_and_centres():
    points = torch.tensor(
        [[-8.0, -4.0, -2.0], [0.6, 0.3, 0.1], [23.99, 3.99, 1.99], [24.0, 0.0, 0.0], [0.0, -4.01, 0.0]]
    )
    cells = GRID.cell_of(points)
    assert cells.tolist() == [[0, 0, 0], [16, 17, 17], [31, 31, 63], [16, 16, 64], [16, -1, 16]]
    assert GRID.contains(points).tolist() == [True, True, True, False, False]
    assert GRID.centre_of(cells[1]).tolist() == pytest.approx([0.75, 0.375, 0.0625])
    assert GRID.normalised(points[:2]).tolist() == [[-1, -1, -1], pytest.approx([-0.4625, 0.075, 0.05])]
    strange = torch.tensor([[math.nan, 0, 0], [math.inf, 0, 0], [0, -math.inf, 0], [0, 0, 1e30]])
    assert not GRID.contains(strange).any()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"upper_m": (24.0, 4.0, 2.1)}, r"z from -2 to 2.1 m must be a whole number of voxels of 0.125 m"),
        ({"upper_m": (24.5, 4.0, 2.0)}, r"x from -8 to 24.5 m is 65 voxels of 0.5 m; must be a multiple of 4"),
        ({"upper_m": (24.0, -5.0, 2.0)}, "y from -4 to -5 m"),
        ({"voxel_m": (0.5, 0.0, 0.1)}, "must be positive"),
        ({"lower_m": (math.nan, 0.0, 0.0)}, "must be three numbers"),
        ({"lower_m": (0.0, 0.0)}, "must be three numbers"),
    ],
)
def test_regions_that_cannot_be(changes, message):
    values = {"lower_m": GRID.lower_m, "upper_m": GRID.upper_m, "voxel_m": GRID.voxel_m, "num_levels": 3}
    with pytest.raises(ConfigError, match=message):
        VoxelGrid(**(values | changes))


def test_levels_and_ground_plane_that_it_lacks():
    with pytest.raises(ValueError, match=r"level=3: the grid has the levels 0..2"):
        GRID.at(3)
    with pytest.raises(ConfigError, match="x and y must be equal"):
        GRID.bev()
