"""Sort keys of (cell, class) pairs: their order, and what they say of the pairs, worked by hand."""

import pytest
import torch

from src.ops.candidate_sort_keys import candidate_sort_keys, unpack_candidates
from src.ops.sites import Sites

SHAPE = (1, 4, 4)
CLASSES = 3
GROUPS = ((2, 0), (1, CLASSES))  # the second has one class


def ranked(scores, cells, peaks=False):
    """Score, row and class of all pairs of each group, best first."""
    sites = Sites.from_linear(torch.tensor(cells), SHAPE)
    keys = candidate_sort_keys(torch.tensor(scores).logit(), sites, GROUPS, peaks)
    assert keys.dtype == torch.int64 and keys.shape == (2, 2 * len(cells))
    scores, rows, classes = unpack_candidates(keys.sort(dim=1, descending=True).values, GROUPS, CLASSES)
    return [
        [(round(s, 4), row, label) for s, row, label in zip(*one, strict=True)]
        for one in zip(scores.tolist(), rows.tolist(), classes.tolist(), strict=True)
    ]


def test_each_group_by_score():
    first, second = ranked([[0.1, 0.9, 0.3], [0.8, 0.5, 0.2]], [0, 5])
    assert first == [(0.8, 1, 0), (0.3, 0, 2), (0.2, 1, 2), (0.1, 0, 0)]
    assert second[:2] == [(0.9, 0, 1), (0.5, 1, 1)]
    assert [score for score, *_ in second[2:]] == [0.0, 0.0]  # what is no class


def test_equal_scores_by_row_and_then_in_the_order_of_the_group():
    first, second = ranked([[0.5, 0.5, 0.5]] * 3, [1, 2, 9])
    assert first == [(0.5, row, label) for row in range(3) for label in (2, 0)]
    assert second[:3] == [(0.5, 0, 1), (0.5, 1, 1), (0.5, 2, 1)]


def test_scores_that_differ_by_one_bit_keep_their_order():
    low = torch.tensor(0.5)
    high = torch.nextafter(low, torch.tensor(1.0))
    sites = Sites.from_linear(torch.tensor([0, 5]), SHAPE)
    logits = torch.stack([torch.zeros(3), torch.full((3,), 2e-7)])
    assert logits.sigmoid()[1, 0] == high
    keys = candidate_sort_keys(logits, sites, GROUPS, False)
    assert unpack_candidates(keys.topk(1, dim=1).values, GROUPS, CLASSES)[1].tolist() == [[1], [1]]


def test_only_local_maxima_score():
    """Cells 0 and 1 touch, 15 stands alone."""
    first, second = ranked([[0.6, 0.2, 0.1], [0.4, 0.7, 0.1], [0.3, 0.1, 0.9]], [0, 1, 15], peaks=True)
    assert first[:4] == [(0.9, 2, 2), (0.6, 0, 0), (0.3, 2, 0), (0.1, 0, 2)]
    assert second[:2] == [(0.7, 1, 1), (0.1, 2, 1)]
    assert {score for score, *_ in second[2:]} == {0.0}


@pytest.mark.parametrize("peaks", [False, True])
def test_no_cells(peaks):
    sites = Sites.from_linear(torch.zeros(0).long(), SHAPE)
    keys = candidate_sort_keys(torch.zeros(0, CLASSES), sites, GROUPS, peaks)
    assert keys.shape == (2, 0)
    assert [part.shape for part in unpack_candidates(keys, GROUPS, CLASSES)] == [(2, 0)] * 3
