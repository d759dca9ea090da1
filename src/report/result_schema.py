"""What tables read of a run's files, as types that are checked when read. Never torch."""

from __future__ import annotations

from typing import Annotated, Any, NotRequired

from pydantic import Field, with_config
from typing_extensions import TypedDict

from src.report.json_format import ANY_KEYS, OPEN, Count, Measure

Share = Annotated[float, Field(ge=0, le=1 + 1e-12)]
"""From 0 to 1; a mean of ones may be 1.0000000000000002."""
Score = Annotated[float, Field(ge=-1e6, le=1e6)]


@with_config(OPEN)
class Errors(TypedDict):
    """Mean errors of true positives; absent where the run was not scored by them, null without ground truth."""

    mATE: NotRequired[Score | None]
    mASE: NotRequired[Score | None]
    mAOE: NotRequired[Score | None]
    mAAE: NotRequired[Score | None]


@with_config(OPEN)
class ClassScores(TypedDict):
    AP: Share
    AVE: NotRequired[Score | None]


class RangeScores(Errors):
    mAP: Share
    NDS: NotRequired[Share | None]
    mAVE: NotRequired[Score | None]
    classes: dict[str, dict[str, Any]]


@with_config(OPEN)
class ClassCount(TypedDict):
    """One class within a speed class."""

    num_gt: Count
    AP_normalized: NotRequired[Share]  # older runs lack it


class ClassAP(ClassCount):
    """A class within a speed class."""

    AP: NotRequired[Share]  # older runs have the car's alone


class CarScores(ClassCount):
    """The car within a speed class."""

    AP: Share
    AVE: Score


@with_config(OPEN)
class SpeedClasses(TypedDict, extra_items=ClassAP):
    """The classes within a speed class, by name."""

    car: CarScores


@with_config(OPEN)
class SpeedScores(TypedDict):
    mAP_present: Share | None
    mAVE_present: Score | None
    mAP_normalized: NotRequired[Share | None]  # older runs lack it, as its classes do
    classes: SpeedClasses


Bounds = Annotated[list[Score], Field(min_length=2, max_length=2)]
"""[low, high] of a score."""


@with_config(OPEN)
class Intervals(TypedDict):
    """95 % intervals of scores over scenes, by the scores' paths in metrics.json."""

    scenes: Count
    bounds: dict[str, Bounds]


class LongRangeScores(RangeScores):
    """Scores by the second protocol, `phase.long_range`."""

    ranges: dict[str, RangeScores]


class Scores(Errors):
    """What tables read of a detection run's metrics.json."""

    mAP: Share
    NDS: Share
    mAVE: Score
    classes: dict[str, ClassScores]
    ranges: dict[str, RangeScores]
    speeds: NotRequired[dict[str, SpeedScores]]  # older runs have none of these
    measures: NotRequired[dict[str, Score | None]]
    long_range: NotRequired[LongRangeScores]
    intervals: NotRequired[Intervals]


@with_config(OPEN)
class OtherScores(TypedDict, extra_items=Measure | dict[str, Any] | None):
    """metrics.json of another task: numbers by name and their intervals are read, what else is nested is not."""

    intervals: NotRequired[Intervals]


@with_config(ANY_KEYS)
class Latency(TypedDict):
    """What tables read of latency.json; the rest is kept as it is."""

    ms: dict[str, Score]
    fps: Score
    memory_gb: Score
    spread_ms: NotRequired[dict[str, Score]]
    gflop: NotRequired[Score]  # older files lack it, as the next two
    load: NotRequired[Score]
    cores: NotRequired[Score]
    trained: NotRequired[bool]  # False of fresh weights


def is_busy(load: float | None, cores: int | None) -> bool:
    """Whether more than half of the processor was taken when a measurement began; not known of older files."""
    return load is not None and cores is not None and load > 0.5 * cores


class DataNames(TypedDict, extra_items=str):
    """What a run was trained and scored on: also version, train_split, split."""

    name: str
    root: str  # the folder's name: of a world its digest


class Seconds(TypedDict, extra_items=Measure):
    """Durations: also fit."""

    all: Measure
    earlier: NotRequired[Measure]  # of the others, before the run was resumed; older files count the last session alone


class CpuProducts(TypedDict):
    """What a CPU multiplies matrices by and in."""

    float32: str
    bfloat16: str  # "never", or from which size on


class PeakMemory(TypedDict, extra_items=Count):
    """MiB: also largest_worker."""

    process: Count
