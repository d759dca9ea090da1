"""LayerNorm with what stands around it, worked by hand."""

import pytest
import torch

from src.ops.add_layer_norm import add_layer_norm, relu_norm_columns

AFFINE = (torch.tensor([1.0, 2.0, 1.0, 1.0]), torch.tensor([0.0, 0.0, 0.5, 0.0]))
X = torch.tensor([[1.0, 3.0, 1.0, 3.0], [4.0, 0.0, 0.0, 4.0]])  # means of 2, deviations of 1 and of 2
NORMED = torch.tensor([[-1.0, 2.0, -0.5, 1.0], [1.0, -2.0, -0.5, 1.0]])


@pytest.mark.parametrize("added", [None, torch.tensor([[5.0, 0.0, 1.0, -2.0], [1.0, 1.0, 0.0, 0.0]])])
@pytest.mark.parametrize("relu", [False, True])
def test_the_sum_is_normed_and_then_cut(added, relu):
    x = X if added is None else X - added
    found, behind = add_layer_norm(x, AFFINE, 0.0, added, relu)
    torch.testing.assert_close(found, NORMED.relu() if relu else NORMED)
    assert behind is None


def test_what_follows_is_added_behind_the_norm_and_of_the_past_alone_what_has_an_age():
    then, old = torch.full((2, 4), 10.0), torch.tensor([[100.0, 200.0, 300.0, 400.0]]).expand(2, 4)
    found, behind = add_layer_norm(X, AFFINE, 0.0, then=then, aged=(old, torch.tensor([0.0, 0.5])))
    torch.testing.assert_close(found, NORMED)
    torch.testing.assert_close(behind, NORMED + 10.0 + torch.stack([torch.zeros(4), old[1]]))


def test_eps_is_added_to_the_variance():
    found, _ = add_layer_norm(X[:1], (torch.ones(4), torch.zeros(4)), 3.0)
    torch.testing.assert_close(found, torch.tensor([[-0.5, 0.5, -0.5, 0.5]]))


def test_gradients():
    draw = torch.Generator().manual_seed(0)
    x, added, then, old = (torch.randn(3, 5, generator=draw, dtype=torch.float64) for _ in range(4))
    scale, shift = (torch.randn(5, generator=draw, dtype=torch.float64) for _ in range(2))
    ages = torch.tensor([0.0, 0.5, 1.0]).double()

    def op(x, added, then, old, scale, shift):
        return add_layer_norm(x, (scale, shift), 1e-5, added, True, then, (old, ages))

    assert torch.autograd.gradcheck(op, [one.requires_grad_() for one in (x, added, then, old, scale, shift)])


def test_positive_parts_are_normed_row_by_row_and_stand_side_by_side():
    """Two branches of two rows: (-3, 1) and (2, 6), (5, -1) and (0, 0)."""
    hidden = torch.tensor([[[-3.0, 1.0], [2.0, 6.0]], [[5.0, -1.0], [0.0, 0.0]]])
    found = relu_norm_columns(hidden, 0.25)
    half, two, five = 0.5 / 0.5**0.5, 2.0 / 4.25**0.5, 2.5 / 6.5**0.5
    torch.testing.assert_close(found, torch.tensor([[-half, half, five, -five], [-two, two, 0.0, 0.0]]))


@pytest.mark.parametrize("rows", [0, 2])
def test_shapes_without_rows(rows):
    found, behind = add_layer_norm(X[:rows], AFFINE, 0.0, then=X[:rows])
    assert found.shape == behind.shape == (rows, 4)
    assert relu_norm_columns(torch.zeros(3, rows, 4), 1e-5).shape == (rows, 12)
