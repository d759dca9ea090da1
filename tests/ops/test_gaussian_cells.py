import torch

from src.geometry.bev_grid import BEVGrid
from src.ops.gaussian_cells import gaussian_cells

GRID = BEVGrid(cells=(12, 16), cell_m=0.8, centre_m=(1.0, -2.0), z_range_m=(-3.0, 5.0))


def test_pairs_are_all_cells_within_reach_in_both_orders():
    generator = torch.Generator().manual_seed(0)
    means = (torch.rand(40, 2, generator=generator) - 0.5) * 16
    scales = torch.rand(40, 2, generator=generator) * 1.5 + 0.2
    angle = torch.rand(40, generator=generator) * 6.3
    directions = torch.stack([angle.cos(), angle.sin()], 1)
    batch = torch.arange(40) % 2
    pairs, support = gaussian_cells(means, scales, directions, batch, GRID, 2, 2.5)

    row, col = torch.meshgrid(torch.arange(12), torch.arange(16), indexing="ij")
    centres = GRID.centre_of(torch.stack([row, col], -1).view(-1, 2), torch.float64)
    delta = centres - means[:, None].double()  # [G, cells, 2]
    rotation = torch.stack([directions, torch.stack([-directions[:, 1], directions[:, 0]], 1)], 1).double()
    q = ((delta @ rotation.mT) / scales[:, None]).square().sum(2)
    wanted = {(g, int(batch[g]) * 192 + c): q[g, c] for g, c in (q <= 2.5**2).nonzero().tolist()}
    keys = support[pairs.cell]
    found = dict(zip(zip(pairs.gaussian.tolist(), keys.tolist(), strict=True), pairs.q.double(), strict=True))
    assert found.keys() == wanted.keys() and len(found) == len(pairs.q) > 100
    torch.testing.assert_close(torch.stack(list(found.values())), torch.stack([wanted[k] for k in found]),
                               rtol=1e-4, atol=1e-4)  # fmt: skip

    assert (keys.diff() >= 0).all() and torch.equal(support, keys.unique())
    assert torch.equal(pairs.cell_starts.diff(), torch.bincount(pairs.cell))
    by_gaussian = pairs.gaussian[pairs.by_gaussian]
    assert torch.equal(by_gaussian, by_gaussian.sort().values)
    assert torch.equal(pairs.gaussian_starts.diff(), torch.bincount(pairs.gaussian, minlength=40))
