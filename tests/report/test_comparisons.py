"""Differences of paired seeds and their interval, by hand and against a t distribution integrated here."""

import math

import pytest

from src.report.comparisons import LOOKS, Comparison, compare, compare_at_looks, t_quantile
from src.report.metric_names import METRICS

MAP, ERROR = METRICS["mAP"], METRICS["mAVE"]


def test_common_seeds_alone_are_compared():
    found = compare({0: 3.0, 1: 5.0, 2: 4.0, 7: 9.0}, {0: 1.0, 1: 4.0, 2: 4.0, 5: 100.0}, 1)
    # 2, 1, 0: mean 1, deviation 1, so 4.303 / sqrt(3) to each side
    assert found == Comparison(1.0, pytest.approx(1 - 2.4843, abs=1e-3), pytest.approx(1 + 2.4843, abs=1e-3), 3, 1)
    assert not found.decided and found.text == "+1.0 [-1.5, +3.5] undecided"
    assert compare({0: 1.0}, {1: 1.0}, 1) is None


def test_what_leaves_out_zero_is_decided_for_the_better_one():
    found = compare({0: 10.0, 1: 10.2, 2: 9.8}, {0: 1.0, 1: 1.0, 2: 1.0}, 1)
    assert found.decided and found.text == "+9.0 [+8.5, +9.5]"
    assert found.favours(MAP) and not found.favours(ERROR)
    turned = compare({0: 1.0, 1: 1.0, 2: 1.0}, {0: 10.0, 1: 10.2, 2: 9.8}, 1)
    assert turned.decided and turned.favours(ERROR) and not turned.favours(MAP)


def test_one_seed_never_decides():
    found = compare({0: 90.0}, {0: 1.0}, 1)
    assert not found.decided and not found.favours(MAP) and found.text == "+89.0 undecided"


def test_pairs_that_do_not_differ_are_equal():
    found = compare({0: 1.5, 1: 2.5, 2: 3.5}, {0: 1.5, 1: 2.5, 2: 3.5}, 1)
    assert found.equal and not found.decided and found.text == "equal"
    assert not compare({0: 1.5}, {0: 1.5}, 1).equal  # says nothing of the next
    assert not compare({0: 1.51, 1: 2.5}, {0: 1.5, 1: 2.5}, 1).equal


def test_an_interval_that_ends_at_zero_as_shown_is_undecided():
    assert not Comparison(0.5, 0.04, 0.96, 3, 1).decided and Comparison(0.5, 0.04, 0.96, 3, 2).decided
    assert not Comparison(-0.5, -0.96, -0.04, 3, 1).decided
    assert Comparison(0.5, 0.04, 0.96, 3, 1).text == "+0.5 [+0.0, +1.0] undecided"


ZERO = dict.fromkeys(range(12), 0.0)


def by_seed(*values):
    return dict(enumerate(values))


def test_a_claim_is_looked_at_after_three_six_and_twelve_pairs():
    # 2, 1, 0: mean 1, deviation 1, so 7.6488 / sqrt(3) to each side
    three = compare_at_looks(by_seed(2.0, 1.0, 0.0), ZERO, 0.5, 1)
    assert (three.mean, three.pairs) == (1.0, 3) and not three.settled(0.5)
    assert (three.low, three.high) == (pytest.approx(-3.4160, abs=1e-4), pytest.approx(5.4160, abs=1e-4))
    for between in ([9.0], [9.0, 9.0]):  # four and five pairs are no look: the first three by number
        assert compare_at_looks(by_seed(2.0, 1.0, 0.0, *between), ZERO, 0.5, 1) == three
    # 2, 1, 0 twice: deviation sqrt(4 / 5), so 3.5341 sqrt(0.8 / 6) to each side
    six = compare_at_looks(by_seed(2.0, 1.0, 0.0, 2.0, 1.0, 0.0, 50.0), ZERO, 0.5, 1)
    assert six.pairs == 6 and six.high == pytest.approx(1 + 1.2905, abs=1e-4) and not six.decided
    # four times: deviation sqrt(8 / 11), so 2.82 sqrt(8 / 11 / 12) to each side
    twelve = compare_at_looks(by_seed(*[2.0, 1.0, 0.0] * 4, 50.0), ZERO | {12: 0.0}, 0.5, 1)
    assert twelve.pairs == 12 and twelve.low == pytest.approx(1 - 0.6942, abs=1e-4) and twelve.decided


def test_the_first_look_that_decides_or_is_precise_stays():
    decided = [5.0, 5.1, 4.9]
    found = compare_at_looks(by_seed(*decided, -90.0, 90.0, -90.0), ZERO, 0.5, 1)
    assert (found.pairs, found.decided) == (3, True)
    # deviation 0.1: 0.44 to each side, and zero is inside
    precise = compare_at_looks(by_seed(0.1, 0.2, 0.0, 5.0, 5.0, 5.0), ZERO, 0.5, 1)
    assert precise.pairs == 3 and precise.settled(0.5) and not precise.decided and not precise.settled(0.4)
    assert compare_at_looks(by_seed(0.1, 0.2, 0.0, 5.0, 5.0, 5.0), ZERO, 0.4, 1).pairs == 6


def test_a_look_is_decided_by_its_bounds_and_not_as_they_are_shown():
    found = compare_at_looks(by_seed(0.41, 0.50, 0.62), ZERO, 0.5, 1)  # [0.045, 0.975]
    assert found.decided and found.favours(MAP) and found.text == "+0.5 [+0.0, +1.0]"
    found = compare_at_looks(by_seed(0.39, 0.50, 0.64), ZERO, 0.56, 1)  # [-0.04, 1.06]
    assert not found.decided and found.settled(0.56) and found.text == "+0.5 [+0.0, +1.1] undecided"


def test_fewer_pairs_than_a_look_have_no_interval():
    found = compare_at_looks({0: 90.0, 3: 91.0, 7: 9.0}, {0: 1.0, 3: 1.0}, 0.5, 1)
    assert found == Comparison(89.5, None, None, 2, 1) and not found.settled(1e9) and found.numbers == "+89.5"
    assert compare_at_looks({0: 1.0}, {1: 1.0}, 0.5, 1) is None


@pytest.mark.parametrize("freedom", [1, 2, 5, 13, 30, 31, 60, 400])
def test_quantiles_are_those_of_students_t(freedom):
    assert area_to(t_quantile(freedom), freedom) == pytest.approx(0.475, abs=2e-4)


def test_quantiles_of_looks_are_those_of_a_third_of_the_error():
    for pairs, quantile in LOOKS.items():
        assert area_to(quantile, pairs - 1) == pytest.approx(0.5 - 0.05 / 3 / 2, abs=1e-6)


def area_to(q, freedom):
    """Student's density by Simpson's rule from 0 to q."""
    n = 2000
    norm = math.exp(math.lgamma((freedom + 1) / 2) - math.lgamma(freedom / 2)) / math.sqrt(freedom * math.pi)
    density = [norm * (1 + (q * k / n) ** 2 / freedom) ** (-(freedom + 1) / 2) for k in range(n + 1)]
    return q / n / 3 * (density[0] + density[-1] + 4 * sum(density[1:-1:2]) + 2 * sum(density[2:-1:2]))
