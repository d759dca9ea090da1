"""Bilinear scatter: whole cells, shares by hand, rows that meet, edges, nothing, gradients."""

import torch

from src.ops.bilinear_scatter import bilinear_scatter

SHAPE = (2, 4, 5)


def scatter(places, sample=None):
    places = torch.tensor(places, dtype=torch.float64).view(-1, 2)
    sample = torch.zeros(len(places), dtype=torch.long) if sample is None else torch.tensor(sample)
    return bilinear_scatter(torch.eye(len(places), dtype=torch.float64), places, sample, SHAPE).view(*SHAPE, -1)


def test_a_row_on_a_centre_comes_through_exactly():
    found = scatter([[3.5, 1.5], [0.5, 3.5]], [0, 1])
    assert found[0, 1, 3].tolist() == [1.0, 0.0] and found[1, 3, 0].tolist() == [0.0, 1.0] and found.sum() == 2.0


def test_a_row_between_centres_is_shared():
    found = scatter([[2.75, 1.5 + 0.5]])[0, :, :, 0]
    wanted = torch.zeros(4, 5, dtype=torch.float64)
    wanted[1, 2] = wanted[2, 2] = 0.375
    wanted[1, 3] = wanted[2, 3] = 0.125
    assert torch.equal(found, wanted)


def test_rows_that_meet_are_averaged_and_what_is_outside_is_dropped():
    found = scatter([[1.5, 1.5], [1.5, 1.5], [5.6, 0.5], [-0.5, 2.5], [0.25, 2.5]])
    assert found[0, 1, 1].tolist() == [0.5, 0.5, 0.0, 0.0, 0.0]
    assert found[..., 2].sum() == found[..., 3].sum() == 0.0 and found[0, 2, 0, 4] == 0.75
    assert not scatter([]).any()


def test_it_is_the_transpose_of_bilinear_sampling():
    """Where rows are more than a cell apart: <scatter(v), m> = <v, sample(m)>."""
    torch.manual_seed(0)
    places = torch.rand(3, 2, dtype=torch.float64) * torch.tensor([0.3, 2.0]) + torch.tensor([0.6, 0.7])
    places[:, 0] += torch.tensor([0.0, 1.3, 2.6])
    values, grid_map = torch.rand(1, 3, dtype=torch.float64).t() * 0.3, torch.rand(4, 5, dtype=torch.float64)
    found = bilinear_scatter(values, places, torch.zeros(3, dtype=torch.long), SHAPE).view(*SHAPE)[0]
    at = places * (2 / torch.tensor([5.0, 4.0])) - 1
    sampled = torch.nn.functional.grid_sample(grid_map[None, None], at[None, None], align_corners=False)[0, 0, 0]
    torch.testing.assert_close((found * grid_map).sum(), (values[:, 0] * sampled).sum())


def test_gradients():
    torch.manual_seed(1)
    places, sample = torch.rand(6, 2, dtype=torch.float64) * 5 - 0.3, torch.tensor([0, 0, 0, 1, 1, 1])
    values = torch.randn(6, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda v: bilinear_scatter(v, places, sample, SHAPE), values)
