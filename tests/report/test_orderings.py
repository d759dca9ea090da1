"""The sign test against sums done by hand, and which orderings are found."""

import pytest

from src.report.orderings import describe_test, find_orderings, paired_gains, sign_test


@pytest.mark.parametrize(
    ("wins", "losses", "p"),
    [
        (0, 0, 1.0),
        (1, 0, 1.0),  # 2 * 1/2
        (3, 0, 2 / 8),
        (5, 0, 2 / 32),
        (6, 0, 2 / 64),
        (5, 1, 2 * (1 + 6) / 64),
        (1, 5, 2 * (1 + 6) / 64),
        (7, 2, 2 * (1 + 9 + 36) / 512),
        (2, 2, 1.0),  # 2 * 11/16 would be more than certain
    ],
)
def test_the_sign_test_is_the_binomial(wins, losses, p):
    assert sign_test(wins, losses) == pytest.approx(p)


def test_five_seeds_cannot_decide_and_six_can():
    assert sign_test(5, 0) > 0.05 > sign_test(6, 0)
    assert describe_test(6, 0) == "sign test n = 6, p = 0.031"


def test_orderings_of_the_paper_are_compared_by_seed():
    paper = {"a": 10.0, "b": 12.0, "c": 12.0, "d": 9.0, "e": 8.0}
    values = {"a": {0: 1.0, 1: 2.0}, "b": {0: 1.5, 1: 1.0, 2: 9.0}, "c": {1: 2.0}, "d": {5: 1.0}, "f": {0: 1.0}}
    found = find_orderings(paper, values, higher_is_better=True, digits=1)
    # b and c are equal in the paper, d shares no seed with any, e has not run, f is not in the paper
    assert [(o.better, o.worse) for o in found] == [("b", "a"), ("c", "a")]
    b_over_a, c_over_a = found
    assert b_over_a.gains == (0.5, -1.0) and not b_over_a.holds
    assert c_over_a.gains == (0.0,) and not c_over_a.holds and c_over_a.ties  # a tie does not hold


def test_less_is_better_turns_the_orderings_round():
    (found,) = find_orderings({"a": 0.9, "b": 0.6}, {"a": {0: 1.0}, "b": {0: 0.7}}, higher_is_better=False, digits=1)
    assert (found.better, found.worse) == ("b", "a")
    assert found.gains == (pytest.approx(0.3),) and found.holds


def test_gains_of_common_seeds_only():
    assert paired_gains({0: 3.0, 1: 5.0}, {1: 4.0, 2: 1.0}) == {1: 1.0}


def test_what_the_digits_shown_hide_does_not_hold():
    (found,) = find_orderings({"a": 2.0, "b": 1.0}, {"a": {0: 10.04}, "b": {0: 10.0}}, True, digits=1)
    assert found.ties and not found.holds
    (found,) = find_orderings({"a": 2.0, "b": 1.0}, {"a": {0: 10.04}, "b": {0: 10.0}}, True, digits=2)
    assert found.holds and not found.ties
