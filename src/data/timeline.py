"""LiDAR frames between key frames: the sweeps nearest to moments at a fixed rate, without labels (lrs 2.3, 2.4)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from src.data.schema import CHANNELS, DatasetIndex
from src.errors import require_least
from src.structures.taxonomy import LIDARS

Array = np.ndarray


class RadialSpeeds(Enum):
    """Where the speed of a return along its ray comes from (lrs 2.5)."""

    none = "none"  # unknown
    radar = "radar"  # compensated Doppler of the radar return beside it
    exact = "exact"  # the synthetic world's true motion


@dataclass(kw_only=True)
class TimelineConfig:
    """Moments of LiDAR frames before and after each key frame (`data.timeline`)."""

    interval_s: float  # between moments
    tolerance_s: float  # a sweep belongs to a moment when it is not further from it
    history_stride: int  # moments from one frame of the past to the next
    horizon_s: float  # rays supervise, and are scored, up to so far into the future
    num_past_targets: int  # frames of the past, drawn in training, whose rays supervise too
    scored_frames: int  # key frames of each scene that a validation with rays reads
    score_stride: int  # moments of the future from one whose rays are scored to the next
    scored_rays: int  # of each such moment at most, drawn
    radial_speeds: RadialSpeeds

    def __post_init__(self) -> None:
        least_values = {"interval_s": 0.01, "tolerance_s": 0, "history_stride": 1, "num_past_targets": 0}
        least_values |= {"scored_frames": 1, "score_stride": 1, "scored_rays": 1, "horizon_s": self.interval_s}
        require_least(self, "data.timeline", least_values)

    @property
    def last_step(self) -> int:
        """The horizon in intervals."""
        return int(self.horizon_s / self.interval_s + 1e-6)

    def history(self, count: int) -> list[int]:
        """Steps of the `count` frames before a key frame, the oldest first."""
        return [-self.history_stride * back for back in range(count, 0, -1)]


class SweepTimeline:
    """The sweeps of some sensors of a data set by scene, in the order of time."""

    def __init__(self, index: DatasetIndex, channels: tuple[str, ...]) -> None:
        self.index, self.channels = index, np.array([CHANNELS.index(channel) for channel in channels])
        rows = np.flatnonzero(np.isin(index.data_channels, self.channels))
        groups = self._groups(index.data_scenes[rows], index.data_channels[rows])
        order = np.lexsort((index.data_times_us[rows], groups))
        self._rows, self._sorted_groups = rows[order], groups[order]
        self._times_us = index.data_times_us[self._rows]

    def nearest(
        self,
        sample: int,  # row of the sample table
        time_us: int,
        tolerance_us: int,
    ) -> Array:  # [channels] int64, rows of the files
        """Of each sensor the sweep of the sample's scene nearest in time; -1 where there is none within tolerance."""
        found = np.full(len(self.channels), -1)
        for channel, (start, end) in enumerate(self._spans(sample)):
            if start == end:
                continue
            after = min(start + int(np.searchsorted(self._times_us[start:end], time_us)), end - 1)
            near = min((max(after - 1, start), after), key=lambda place: abs(int(self._times_us[place]) - time_us))
            if abs(int(self._times_us[near]) - time_us) <= tolerance_us:
                found[channel] = self._rows[near]
        return found

    def between(self, sample: int, first_us: int, last_us: int) -> Array:  # [n] int64, rows of the files
        """All sweeps of the sample's scene from one time to another, borders included."""
        picked = []
        for start, end in self._spans(sample):
            times_us = self._times_us[start:end]
            low, high = np.searchsorted(times_us, first_us), np.searchsorted(times_us, last_us, "right")
            picked.append(self._rows[start + low : start + high])
        return np.concatenate(picked)

    def _groups(self, scenes: Array, channels: Array) -> Array:  # [n] int64
        return scenes.astype(np.int64) * len(CHANNELS) + channels

    def _spans(self, sample: int) -> list[tuple[int, int]]:
        groups = self._groups(np.array(self.index.sample_scenes[sample]), self.channels)
        starts = np.searchsorted(self._sorted_groups, groups)
        ends = np.searchsorted(self._sorted_groups, groups, "right")
        return list(zip(starts.tolist(), ends.tolist(), strict=True))


class LidarTimeline:
    """The moments about each key frame at which there is LiDAR."""

    def __init__(self, index: DatasetIndex, config: TimelineConfig) -> None:
        self.index, self.config, self._sweeps = index, config, SweepTimeline(index, LIDARS)

    def time_us(self, sample: int, step: int) -> int:
        """The moment so many intervals after a key frame."""
        return int(self.index.frame_times_us[sample]) + round(1e6 * step * self.config.interval_s)

    def sweeps(self, sample: int, step: int) -> Array:  # [6] int64 by LIDARS, -1 for none
        """The files of a moment; none where the scene has ended or not begun."""
        return self._sweeps.nearest(sample, self.time_us(sample, step), round(1e6 * self.config.tolerance_s))

    def targets(
        self,
        sample: int,
        num_history: int,
        num_future: int,
        rng: np.random.Generator | None,
    ) -> list[int]:
        """Steps whose rays supervise (O18): 0, some of the past and `num_future` of those up to the horizon, drawn.

        Only such as the scene has, so there may be fewer. Without `rng` 0 and all of the future.
        """
        future = self._existing(sample, range(1, self.config.last_step + 1))
        if rng is None:
            return [0, *future]
        past = self._existing(sample, self.config.history(num_history))
        draws = ((past, self.config.num_past_targets), (future, num_future))
        picked = [rng.choice(steps, min(count, len(steps)), replace=False) for steps, count in draws]
        return sorted(int(step) for step in np.concatenate([[0], *picked]))

    def is_whole(self, sample: int) -> bool:
        """Whether the scene goes on to the horizon of a key frame."""
        return bool(self._existing(sample, [self.config.last_step]))

    def _existing(self, sample: int, steps: range | list[int]) -> list[int]:
        return [step for step in steps if (self.sweeps(sample, step) >= 0).any()]
