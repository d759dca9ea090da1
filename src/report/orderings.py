"""Which of the paper's orderings of two rows hold here: differences seed by seed and an exact sign test."""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass

LEAST_SEEDS = 6
"""Two-sided, five seeds that all agree still have p = 2 / 2^5 = 0.0625; six have 0.031."""


@dataclass(frozen=True)
class Ordering:
    """One row that the paper has before another, by one metric, and what is seen here."""

    better: str  # label of the row that is better in the paper
    worse: str
    gains: tuple[float, ...]  # better minus worse in the metric's direction, here, of each seed that both rows have
    digits: int  # that are shown

    @property
    def holds(self) -> bool:
        """Whether the better row is the better one here too, in the mean, and by more than the digits shown hide."""
        return statistics.mean(self.gains) > 0 and not self.ties

    @property
    def ties(self) -> bool:
        """Whether the mean difference is none at the digits shown."""
        return round(statistics.mean(self.gains), self.digits) == 0


def sign_test(wins: int, losses: int) -> float:
    """Exact two-sided p of as uneven a split or a more uneven one, were both sides equally likely; 1 without any."""
    n = wins + losses
    tail = sum(math.comb(n, k) for k in range(min(wins, losses) + 1)) / 2**n
    return min(1.0, 2 * tail)


def paired_gains(first: dict[int, float], second: dict[int, float]) -> dict[int, float]:
    """`first` minus `second` of every seed that both have."""
    return {seed: first[seed] - second[seed] for seed in first if seed in second}


def find_orderings(
    paper: dict[str, float],  # by row label
    values: dict[str, dict[int, float]],  # by row label and seed
    higher_is_better: bool,
    digits: int,  # that are shown
) -> list[Ordering]:
    """Every two rows that the paper tells apart and that share a seed here; the paper's best first."""
    sign = 1.0 if higher_is_better else -1.0
    known = sorted((label for label in paper if values.get(label)), key=lambda label: -sign * paper[label])
    found = []
    for place, better in enumerate(known):
        for worse in known[place + 1 :]:
            gains = tuple(sign * gain for _, gain in sorted(paired_gains(values[better], values[worse]).items()))
            if gains and paper[better] != paper[worse]:
                found.append(Ordering(better, worse, gains, digits))
    return found


def describe_test(wins: int, losses: int) -> str:
    """The sign test in words."""
    return f"sign test n = {wins + losses}, p = {sign_test(wins, losses):.2g}"
