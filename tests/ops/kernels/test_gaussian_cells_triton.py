import pytest
import torch

from src.geometry.bev_grid import BEVGrid
from src.ops.fixed_shapes import Capacities, FixedShapes, in_fixed_shapes
from src.ops.gaussian_cells import gaussian_cells

GRID = BEVGrid(cells=(12, 16), cell_m=0.8, centre_m=(1.0, -2.0), z_range_m=(-3.0, 5.0))
NUM_CELLS = 2 * 12 * 16


def random_gaussians(count):
    """Some at the edge, some beyond it, and two that are nowhere."""
    draw = torch.Generator().manual_seed(0)
    means = (torch.rand(count, 2, generator=draw) - 0.5) * 20
    means[3:4], means[5:6, 1] = 1e6, torch.nan
    angle = 6 * torch.rand(count, generator=draw)
    scales = 0.2 + torch.rand(count, 2, generator=draw)
    return means, scales, torch.stack([angle.cos(), angle.sin()], 1), torch.arange(count) * 2 // max(count, 1)


def found_on(device, dtype, gaussians):
    means, scales, directions, batch = gaussians
    inputs = (*(x.to(device, dtype) for x in (means, scales, directions)), batch.to(device))
    return gaussian_cells(*inputs, GRID, 2, 2.5)


def by_gaussian(pairs, support):
    """Gaussian and cell of the pairs in the order of the Gaussians, those without a cell left out."""
    order = pairs.by_gaussian.long()
    cells = support[pairs.cell.long()[order]]
    return torch.stack([pairs.gaussian.long()[order], cells], 1)[cells < NUM_CELLS].cpu()


@pytest.mark.parametrize("count", [0, 1, 300])
def test_pairs_of_any_number(device, count):
    gaussians = random_gaussians(count)
    pairs, support = found_on(device, torch.float32, gaussians)
    wanted, wanted_support = found_on(device, torch.float64, gaussians)
    assert torch.equal(support, wanted_support) and len(pairs.q) == len(wanted.q)
    for name in ("gaussian", "cell", "cell_starts", "by_gaussian", "gaussian_starts"):
        assert torch.equal(getattr(pairs, name).long(), getattr(wanted, name).long()), name
    torch.testing.assert_close(pairs.q.double(), wanted.q, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(pairs.delta.double(), wanted.delta, rtol=0, atol=1e-5)


def test_pairs_in_fixed_shapes(device):
    """Padding is at infinite distance and belongs to no cell."""
    gaussians, shapes = random_gaussians(300), Capacities(1, 1, 1, 9000)
    with in_fixed_shapes(FixedShapes(shapes, GRID.cells)) as fixed:
        pairs, support = found_on(device, torch.float32, gaussians)
        assert not fixed.overflow()
    with in_fixed_shapes(FixedShapes(shapes, GRID.cells)):
        wanted, wanted_support = found_on(device, torch.float64, gaussians)
    assert torch.equal(support, wanted_support) and len(support) == NUM_CELLS + 1
    assert len(pairs.cell_starts) == NUM_CELLS + 2 and len(pairs.gaussian_starts) == 301
    assert torch.equal(pairs.cell.long(), wanted.cell.long())
    assert torch.equal(pairs.cell_starts.long(), wanted.cell_starts.long())
    near = pairs.cell < NUM_CELLS
    assert torch.equal(pairs.gaussian[near].long(), wanted.gaussian[near])
    assert (pairs.q[~near] == torch.inf).all()
    torch.testing.assert_close(pairs.q[near].double(), wanted.q[near], rtol=1e-4, atol=1e-4)
    assert torch.equal(by_gaussian(pairs, support), by_gaussian(wanted, wanted_support))
    starts = pairs.gaussian_starts.tolist()
    for gaussian in (0, 7, 299):
        own = pairs.by_gaussian[starts[gaussian] : starts[gaussian + 1]].long()
        assert (pairs.gaussian[own] == gaussian).all()


def test_pairs_beyond_the_capacity_overflow(device):
    with in_fixed_shapes(FixedShapes(Capacities(1, 1, 1, 1000), GRID.cells)) as fixed:
        pairs, _ = found_on(device, torch.float32, random_gaussians(300))
        assert fixed.overflow()
    assert len(pairs.q) == pairs.gaussian_starts[-1] == 1000
    assert torch.equal(pairs.by_gaussian.sort().values.long(), torch.arange(1000, device=device))
