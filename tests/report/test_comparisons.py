"""Differences of paired seeds and their interval, by hand and against a t distribution integrated here."""

import math

import pytest

from src.report.comparisons import Comparison, compare, t_quantile
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


def test_an_interval_that_ends_at_zero_as_shown_is_undecided():
    assert not Comparison(0.5, 0.04, 0.96, 3, 1).decided and Comparison(0.5, 0.04, 0.96, 3, 2).decided
    assert not Comparison(-0.5, -0.96, -0.04, 3, 1).decided
    assert Comparison(0.5, 0.04, 0.96, 3, 1).text == "+0.5 [+0.0, +1.0] undecided"


@pytest.mark.parametrize("freedom", [1, 2, 5, 13, 30, 31, 60, 400])
def test_quantiles_are_those_of_students_t(freedom):
    """The density by Simpson's rule from 0 to the quantile is 0.475."""
    q, n = t_quantile(freedom), 2000
    norm = math.exp(math.lgamma((freedom + 1) / 2) - math.lgamma(freedom / 2)) / math.sqrt(freedom * math.pi)
    density = [norm * (1 + (q * k / n) ** 2 / freedom) ** (-(freedom + 1) / 2) for k in range(n + 1)]
    area = q / n / 3 * (density[0] + density[-1] + 4 * sum(density[1:-1:2]) + 2 * sum(density[2:-1:2]))
    assert area == pytest.approx(0.475, abs=2e-4)
