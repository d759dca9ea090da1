"""The best candidates in fixed shapes are those of `top_candidates`, in its order."""

import torch

from src.models.heads.decode import top_candidates
from src.models.heads.fixed_decode import best_candidates
from src.ops.sites import Sites
from src.targets.heatmap import HEAD_GROUPS


def test_candidates_and_ties_are_those_of_varying_shapes():
    draw = torch.Generator().manual_seed(0)
    logits = (torch.randint(0, 12, (40, 12), generator=draw) / 12).logit()  # many are equal
    wanted = top_candidates(logits.sigmoid(), torch.zeros(40, dtype=torch.int64), 1, 0.3, limit=30)
    best, rows, labels = best_candidates(logits, Sites.from_linear(torch.arange(40), (1, 5, 8)), 30, peaks=False)
    assert best.shape == (len(HEAD_GROUPS), 30)
    first = 0
    for group, (count,) in enumerate(wanted.counts):
        span = slice(first, first + count)
        assert torch.equal(rows[group, :count], wanted.rows[span])
        assert torch.equal(labels[group, :count], wanted.labels[span])
        assert torch.equal(best[group, :count], wanted.scores[span])
        assert count == 30 or (best[group, count:] <= 0.3).all()
        first += count


def test_a_class_that_a_group_lacks_is_never_chosen():
    logits = torch.full((2, 12), -torch.inf)
    logits[1, 0] = 0.0  # a car, alone in its group
    best, rows, labels = best_candidates(logits, Sites.from_linear(torch.arange(2), (1, 1, 2)), 6, peaks=False)
    assert (best[0, 0], rows[0, 0], labels[0, 0]) == (0.5, 1, 0) and best.sum() == 0.5
    assert labels.max() < 12 and rows.max() < 2
