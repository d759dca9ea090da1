"""What points say of the cells around them, worked by hand; what is made of it: tests/models/layers/test_doppler.py."""

import pytest
import torch

from src.geometry.bev_grid import BEVGrid
from src.ops.moved_keys import NONE
from src.ops.radial_correction import BIN_MPS, NUM_BINS, radial_bin, radial_correction, radial_votes

GRID = BEVGrid(cells=(6, 8), cell_m=1.0, centre_m=(4.0, 0.0), z_range_m=(-3.0, 5.0))  # x 0 to 8, y -3 to 3
HALF = NUM_BINS // 2


def point(x, y, vx, vy):
    return [x, y, 1.0, 0.0, vx, vy, 0.1]


def test_bins_are_of_signed_speed_and_end():
    speeds = torch.tensor([-1e3, -BIN_MPS, -0.51 * BIN_MPS, -0.49 * BIN_MPS, 0.0, 0.49 * BIN_MPS, 1.4 * BIN_MPS, 1e3])
    assert (radial_bin(speeds) - HALF).tolist() == [-HALF, -1, -1, 0, 0, 0, 1, HALF]


def test_a_point_in_the_middle_votes_for_25_cells():
    """In cell (3, 4) of the second sample, 13 m/s towards the ego: bin -2."""
    keys, values = radial_votes(torch.tensor([point(4.5, 0.5, -13.0, 0.0)]), torch.tensor([1]), GRID)
    row, col = torch.meshgrid(torch.arange(1, 6), torch.arange(2, 7), indexing="ij")
    assert torch.equal(keys, (((6 + row) * 8 + col) * NUM_BINS + HALF - 2).flatten())
    falloff = torch.tensor([1.0, 2, 3, 2, 1])
    assert torch.equal(values[:, 0].view(5, 5), falloff[:, None] * falloff)
    torch.testing.assert_close(values[:, 1:], values[:, :1] * torch.tensor([-13.0, 0.0]))


def test_there_are_no_votes_beside_the_grid_nor_of_points_beside_it():
    points = [point(0.5, -2.5, 1.0, 0.0), point(7.5, 2.5, 1.0, 0.0), point(-0.5, 0.0, 9.0, 0.0)]
    keys, _ = radial_votes(torch.tensor(points), torch.zeros(3).long(), GRID)
    corner, other, outside = keys.view(3, 25)
    assert (corner != NONE).view(5, 5).nonzero().tolist() == [[a, b] for a in (2, 3, 4) for b in (2, 3, 4)]
    assert (other != NONE).view(5, 5).nonzero().tolist() == [[a, b] for a in (0, 1, 2) for b in (0, 1, 2)]
    assert (outside == NONE).all()


def test_of_two_near_bins_the_nearer_value_is_taken_in_both_forms_of_cells():
    """In cell (3, 4), seen along (4.5, 0.5): 10 and 16 m/s were measured; 11 and 15 are said."""
    cell = (3 * 8 + 4) * NUM_BINS + HALF
    keys = torch.tensor([cell + 2, cell + 3])
    sight = torch.tensor([4.5, 0.5]) / (4.5**2 + 0.5**2) ** 0.5
    measured = torch.stack([10 * sight, 16 * sight])
    said = torch.stack([11 * sight, 15 * sight])
    cells = torch.tensor([28, 28])
    change = radial_correction(said, cells, keys, measured, GRID)
    torch.testing.assert_close(change, torch.stack([-sight, sight]))
    places = torch.tensor([[[4.2, 0.9], [4.9, 0.1]]])
    torch.testing.assert_close(radial_correction(said, places, keys, measured, GRID, added=True), measured)


@pytest.mark.parametrize("added", [False, True])
def test_without_measurements_nothing_changes(added):
    said = torch.tensor([[3.0, 4.0]])
    found = radial_correction(said, torch.tensor([9]), torch.zeros(0).long(), torch.zeros(0, 2), GRID, added)
    assert found.tolist() == ([[3.0, 4.0]] if added else [[0.0, 0.0]])
