import pytest
import torch

from src.geometry.bev_grid import BEVGrid
from src.models.layers.doppler import Doppler
from src.ops.radial_correction import (
    BIN_MPS,
    radial_correction,
    radial_correction_reference,
    radial_votes,
    radial_votes_reference,
)
from tests.models.radial import MEASURED

GRID = BEVGrid(cells=(12, 16), cell_m=0.8, centre_m=(8.0, 0.0), z_range_m=(-3.0, 5.0))


@pytest.mark.parametrize("count", [0, 200])
def test_votes(device, count):
    """Of points in and around the grid, some not finite, of speeds beyond all bins, and of none."""
    draw = torch.Generator().manual_seed(count)
    rows = torch.rand(count, 7, generator=draw) * torch.tensor([16.0, 14, 1, 1, 300, 300, 1])
    rows -= torch.tensor([0.0, 7, 0, 0, 150, 150, 0])
    rows[::9, 4:6], rows[3::40, 0], rows[5::40, 1] = 0.0, torch.nan, torch.inf
    batch = torch.randint(0, 3, (count,), generator=draw)
    wanted = radial_votes_reference(rows, batch, GRID)
    for value, expected in zip(radial_votes(rows.to(device), batch.to(device), GRID), wanted, strict=True):
        assert torch.equal(value.cpu(), expected)


@pytest.mark.parametrize(("points", "count"), [(0, 5), (60, 0), (60, 1), (60, 700)])
def test_changes(device, points, count):
    draw = torch.Generator().manual_seed(points + count)
    rows = torch.rand(points, 7, generator=draw) * torch.tensor([12.8, 9.6, 1, 1, 80, 80, 1])
    rows -= torch.tensor([-1.6, 4.8, 0, 0, 40, 40, 0])
    rows[::2, 4:6] *= 1e-2  # standing
    doppler = Doppler.measure(rows, torch.arange(points) % 2, GRID, MEASURED)
    velocities = 15 * torch.randn(count, 2, generator=draw)
    cells = torch.randint(0, 2 * 12 * 16, (count,), generator=draw)
    inputs = (velocities, cells, doppler.keys, doppler.velocities)
    found = radial_correction(*(x.to(device) for x in inputs), GRID).cpu()
    torch.testing.assert_close(found, radial_correction_reference(*inputs, GRID), rtol=1e-4, atol=1e-4)
    assert count < 700 or (found != 0).any(1).float().mean() > 0.2


@pytest.mark.parametrize("added", [False, True])
def test_changes_at_positions(device, added):
    draw = torch.Generator().manual_seed(2)
    rows = torch.rand(60, 7, generator=draw) * torch.tensor([12.8, 9.6, 1, 1, 80, 80, 1])
    rows -= torch.tensor([-1.6, 4.8, 0, 0, 40, 40, 0])
    doppler = Doppler.measure(rows, torch.arange(60) % 2, GRID, MEASURED)
    positions = torch.rand(2, 150, 2, generator=draw) * torch.tensor([12.8, 9.6]) - torch.tensor([-1.6, 4.8])
    inputs = (15 * torch.randn(300, 2, generator=draw), positions, doppler.keys, doppler.velocities)
    found = radial_correction(*(x.to(device) for x in inputs), GRID, added).cpu()
    row, col = GRID.cell_of(positions).unbind(-1)
    cells = ((torch.arange(2)[:, None] * 12 + row) * 16 + col).flatten()
    expected = radial_correction_reference(inputs[0], cells, *inputs[2:], GRID) + added * inputs[0]
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)


def test_halves_go_to_the_even_bin(device):
    """Of radial speeds between two bins, whose nearest measurements differ."""
    grid = BEVGrid(cells=(13, 16), cell_m=0.8, centre_m=(8.0, 0.0), z_range_m=(-3.0, 5.0))
    cell, sight = torch.tensor([6 * 16 + 15]), torch.tensor([[1.0, 0.0]])  # straight ahead
    bins = torch.arange(0, 31, 3)
    velocities = (torch.arange(-6, 6)[:, None] + 0.5) * BIN_MPS * sight
    inputs = (velocities, cell.expand(12), cell * 31 + bins, (bins[:, None] - 15) * BIN_MPS * sight)
    found = radial_correction(*(x.to(device) for x in inputs), grid).cpu()
    torch.testing.assert_close(found, radial_correction_reference(*inputs, grid))
