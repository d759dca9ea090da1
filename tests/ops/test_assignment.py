"""Minimum-cost assignment: all permutations as oracle, ties, nothing to assign, costs that are not finite."""

import itertools

import numpy as np
import pytest

from src.ops.assignment import assign


def least_sum(cost):
    """Of all ways to give each row another column, there being as many columns at least."""
    n, m = cost.shape
    return min(sum(cost[row, column] for row, column in enumerate(way)) for way in itertools.permutations(range(m), n))


def test_by_hand():
    """The cheapest column of both rows is the first; the second row loses less by the other."""
    rows, columns = assign(np.array([[1.0, 9.0, 8.0], [2.0, 3.0, 4.0]]))
    assert rows.tolist() == [0, 1] and columns.tolist() == [0, 1]


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (3, 3), (3, 6), (5, 5), (4, 7)])
def test_no_permutation_costs_less(shape):
    generator = np.random.default_rng(0)
    for cost in (generator.normal(size=shape), generator.integers(0, 3, shape).astype(float), np.zeros(shape)):
        rows, columns = assign(cost)
        assert rows.tolist() == [*range(shape[0])] and len(set(columns.tolist())) == shape[0]
        assert cost[rows, columns].sum() == pytest.approx(least_sum(cost))
        back_rows, back_columns = assign(cost.T)
        assert (np.diff(back_rows) > 0).all()
        assert cost.T[back_rows, back_columns].sum() == pytest.approx(least_sum(cost))


@pytest.mark.parametrize("shape", [(0, 0), (0, 4), (4, 0)])
def test_nothing_to_assign(shape):
    rows, columns = assign(np.zeros(shape))
    assert len(rows) == len(columns) == 0


def test_many_rows_and_costs_that_are_not_finite():
    cost = np.random.default_rng(0).normal(size=(60, 300))
    rows, columns = assign(cost)
    assert len(set(columns.tolist())) == 60
    assert sum(cost.min(1)) <= cost[rows, columns].sum()
    chosen, other = cost[rows, columns], cost[:, columns]  # [60], [60, 60]
    assert (chosen[:, None] + chosen[None] <= other + other.T + 1e-12).all()  # no exchange of two rows is cheaper
    assert (chosen <= np.delete(cost, columns, 1).min(1)).all()  # nor is a free column
    cost[:, ::2] = np.nan
    rows, columns = assign(cost)
    assert (columns % 2 == 1).all()
    assert len(assign(np.full((3, 4), np.inf))[0]) == 3
