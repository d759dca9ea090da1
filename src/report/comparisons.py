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

UNDECIDED = "undecided"
_T = (
    *(12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179, 2.160, 2.145, 2.131),
    *(2.120, 2.110, 2.101, 2.093, 2.086, 2.080, 2.074, 2.069, 2.064, 2.060, 2.056, 2.052, 2.048, 2.045, 2.042),
)
"""Of Student's t the two-sided 95 % point for 1 to 30 degrees of freedom."""
_Z = 1.960


@dataclass(frozen=True)
class Comparison:
    """What one row has more than another, in the table's unit."""

    mean: float
    low: float | None  # 95 % interval; None of one pair, which says nothing of the next
    high: float | None
    pairs: int
    digits: int  # that are shown

    @property
    def decided(self) -> bool:
        """Whether the interval as it is shown leaves out zero."""
        return self.low is not None and (round(self.low, self.digits) > 0 or round(self.high, self.digits) < 0)

    def favours(self, metric: Metric) -> bool:
        """Whether it is decided for the first row."""
        return self.decided and (self.mean > 0) == metric.higher_is_better

    @property
    def text(self) -> str:
        """Difference and interval, and that it is undecided."""
        text = _signed(self.mean, self.digits)
        text += "" if self.low is None else f" [{_signed(self.low, self.digits)}, {_signed(self.high, self.digits)}]"
        return text if self.decided else f"{text} {UNDECIDED}"


def compare(
    first: Mapping[int, float],  # by seed
    second: Mapping[int, float],
    digits: int,
) -> Comparison | None:
    """`first` minus `second` over the seeds that both have; None without any."""
    gains = [first[seed] - second[seed] for seed in first if seed in second]
    if not gains:
        return None
    mean = statistics.mean(gains)
    if len(gains) == 1:
        return Comparison(mean, None, None, 1, digits)
    half = t_quantile(len(gains) - 1) * statistics.stdev(gains) / math.sqrt(len(gains))
    return Comparison(mean, mean - half, mean + half, len(gains), digits)


def t_quantile(freedom: int) -> float:
    """Two-sided 95 % point of Student's t."""
    if freedom <= len(_T):
        return _T[freedom - 1]
    return _Z * (1 + (_Z**2 + 1) / (4 * freedom))  # the expansion of it, too small by 0.003 at most


def _signed(value: float, digits: int) -> str:
    return f"{round(value, digits) + 0.0:+.{digits}f}"
