"""From [B, G] Gaussians to cells and back to [B, G]."""

import torch

from src.models.horizon3d.splatting import splat_set
from tests.gaussian_sets import gaussians_at
from tests.models.horizon3d.cells import rows_at


def make_set(means, opacity_logits, valid):
    b, g, _ = means.shape
    columns = {"scales": torch.full((b, g, 2), 0.5), "features": torch.ones(b, g, 3)}
    return gaussians_at(means, opacity_logits=opacity_logits, valid=valid, **columns)


def test_padding_is_not_splatted_and_results_return_to_their_gaussians(grid):
    cells = torch.tensor([[[10, 10], [20, 20], [30, 30]], [[5, 5], [15, 15], [25, 25]]])
    logits = torch.tensor([[2.0, 2.0, -9.0], [2.0, 2.0, 2.0]])
    valid = torch.tensor([[True, False, True], [False, True, True]])
    splat = splat_set(make_set(grid.centre_of(cells), logits, valid), grid, 0.1, 1000, 3.0)
    assert splat.active().tolist() == [[True, False, False], [False, True, True]]  # too faint, or padding
    linear = (torch.arange(2)[:, None] * grid.rows + cells[..., 0]) * grid.cols + cells[..., 1]
    assert torch.equal(splat.peak_cells, torch.where(splat.active(), linear, -1))
    touched = splat.bev.indices
    assert not ((touched[:, 0] == 0) & (touched[:, 1] == 20)).any()
    torch.testing.assert_close(rows_at(splat.bev, torch.tensor([[0, 10, 10]])), torch.ones(1, 3))  # k = 1 at the centre


def test_no_gaussian_at_all(grid):
    means = grid.centre_of(torch.zeros(2, 3, 2, dtype=torch.int64))
    splat = splat_set(make_set(means, torch.zeros(2, 3), torch.zeros(2, 3, dtype=torch.bool)), grid, 0.1, 1000, 3.0)
    assert len(splat.bev) == 0 and splat.bev.features.shape == (0, 3)
    assert not splat.active().any() and (splat.peak_cells == -1).all()


def test_a_gaussian_is_active_by_what_it_contributes_to_an_occupied_cell(grid):
    """One opens cells; a faint one lies on it, a strong one touches it with its tail, one is alone and too faint."""
    cells = torch.tensor([[[10, 10], [10, 10], [10, 13], [30, 30]]])
    means = grid.centre_of(cells)
    means[0, 2, 0] -= 0.2  # 1.4 m from cell (10, 11), which the first one opens, too: q = 7.84
    probabilities = torch.tensor([[0.9, 0.02, 0.09, 0.05]])
    splat = splat_set(make_set(means, torch.logit(probabilities), torch.ones(1, 4).bool()), grid, 0.1, 1000, 3.0)
    tail = 0.09 * torch.tensor(-0.5 * 7.84).exp().item()
    torch.testing.assert_close(splat.peak_contributions, torch.tensor([[0.9, 0.02, tail, 0.0]]))
    for least, expected in ((0.0, [1, 1, 1, 0]), (0.01, [1, 1, 0, 0]), (0.1, [1, 0, 0, 0])):
        assert splat.active(least).tolist() == [[bool(one) for one in expected]]
