"""Which of two rows is better: differences of runs of the same seed, and an interval that may leave it undecided.

The interval is Student's t over paired seeds. Runs of a pair share their seed and are scored on the same scenes, whose
difficulty cancels in the difference; what is left, and what another training would draw anew, is the seed's own noise.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping
from dataclasses import dataclass

from src.report.metric_names import Metric

UNDECIDED, EQUAL = "undecided", "equal"
_T = (
    *(12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179, 2.160, 2.145, 2.131),
    *(2.120, 2.110, 2.101, 2.093, 2.086, 2.080, 2.074, 2.069, 2.064, 2.060, 2.056, 2.052, 2.048, 2.045, 2.042),
)
"""Two-sided 95 % point of Student's t for 1 to 30 degrees of freedom."""
_Z = 1.960

LOOKS = {3: 7.6488, 6: 3.5341, 12: 2.8200}
"""Paired seeds at which a claim is looked at, and Student's two-sided point of 1 - 0.05/3 for them.

Bonferroni over the three looks: whichever of them decides first, the error is at most 5 %.
"""


@dataclass(frozen=True)
class Comparison:
    """What one row has more than another, in the table's unit."""

    mean: float
    low: float | None  # 95 % interval, or that of a look; None of too few pairs, which say nothing of the next
    high: float | None
    pairs: int
    digits: int  # that are shown
    exact: bool = False  # of a look: what is shown decides nothing

    @property
    def decided(self) -> bool:
        """Whether the interval leaves out zero, as it is shown or `exact`."""
        if self.low is None:
            return False
        low, high = (end if self.exact else round(end, self.digits) for end in (self.low, self.high))
        return low > 0 or high < 0

    @property
    def equal(self) -> bool:
        """Whether no pair differs, as where a row's change cannot reach the metric."""
        return self.low == self.high == 0

    def favours(self, metric: Metric) -> bool:
        """Whether it is decided for the first row."""
        return self.decided and (self.mean > 0) == metric.higher_is_better

    def settled(self, half_width: float) -> bool:
        """Whether it is decided, or its interval is no wider than twice `half_width`."""
        return self.decided or (self.low is not None and self.high - self.low <= 2 * half_width)

    @property
    def numbers(self) -> str:
        """Difference and interval."""
        text = _signed(self.mean, self.digits)
        bounds = "" if self.low is None else f" [{_signed(self.low, self.digits)}, {_signed(self.high, self.digits)}]"
        return text + bounds

    @property
    def text(self) -> str:
        """The numbers, and that it is undecided; or that all pairs are equal."""
        if self.equal:
            return EQUAL
        return self.numbers if self.decided else f"{self.numbers} {UNDECIDED}"


def compare(
    first: Mapping[int, float],  # by seed
    second: Mapping[int, float],
    digits: int,
) -> Comparison | None:
    """`first` minus `second` over the seeds that both have; None without any."""
    gains = _gains(first, second)
    if not gains:
        return None
    return _with_interval(gains, t_quantile(len(gains) - 1) if len(gains) > 1 else None, digits)


def compare_at_looks(
    first: Mapping[int, float],  # by seed
    second: Mapping[int, float],
    half_width: float,  # that is precise enough, in the table's unit
    digits: int,
) -> Comparison | None:
    """`first` minus `second` at the first of `LOOKS` that is decided or precise enough, else at the last one reached.

    A look is at the pairs of the smallest seeds. Before the first look there is a mean and no interval; None without
    any pair.
    """
    gains = _gains(first, second)
    found = _with_interval(gains, None, digits) if gains else None
    for pairs, quantile in LOOKS.items():
        if pairs > len(gains):
            break
        found = _with_interval(gains[:pairs], quantile, digits, exact=True)
        if found.settled(half_width):
            break
    return found


def _gains(first: Mapping[int, float], second: Mapping[int, float]) -> list[float]:
    return [first[seed] - second[seed] for seed in sorted(first) if seed in second]


def _with_interval(gains: list[float], quantile: float | None, digits: int, exact: bool = False) -> Comparison:
    mean = statistics.mean(gains)
    if quantile is None:
        return Comparison(mean, None, None, len(gains), digits)
    half = quantile * statistics.stdev(gains) / math.sqrt(len(gains))
    return Comparison(mean, mean - half, mean + half, len(gains), digits, exact)


def t_quantile(freedom: int) -> float:
    """Two-sided 95 % point of Student's t."""
    if freedom <= len(_T):
        return _T[freedom - 1]
    return _Z * (1 + (_Z**2 + 1) / (4 * freedom))  # the expansion of it, too small by 0.003 at most


def _signed(value: float, digits: int) -> str:
    return f"{round(value, digits) + 0.0:+.{digits}f}"
