"""The numbers that tables and sweeps may name: meaning, unit, direction. Imports no torch."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from src.errors import ConfigError
from src.structures.taxonomy import CLASSES, SOURCES

DETECTION = "detection"
"""The task (`phase.task`) whose numbers have names here."""
RANGES = ("0-25", "25-50", "50-100", "100-150")
LONG_RANGES = ("0-50", "50-150", "150-250")
"""Distance ranges (m) of the second score of detections (`phase.long_range`)."""
SPEEDS = ("0-0.5", "0.5-10", "10-25", "25+")
PARTS = ("image_encoder", "radar_encoder", "kggi", "ocsf", "dptf", "detection_head", "total")
"""What a frame's latency is made of (Table 15)."""
FURTHER_PARTS = ("gaussian_encoder", "view_transform", "temporal_fusion", "lidar_encoder")
"""The encoder within `ocsf` (Table 14), and what only other methods have (Table 15)."""


@dataclass(frozen=True)
class Metric:
    """One number of a run as tables show it."""

    name: str  # path within a result's metrics
    title: str
    unit: str = ""  # empty where the title says it
    scale: float = 1.0  # from the result's unit to the table's: fractions of 1 become percent
    digits: int = 3
    higher_is_better: bool = True

    @property
    def heading(self) -> str:
        """Title and unit, as over a column."""
        return f"{self.title}, {self.unit}" if self.unit else self.title


PERCENT = {"unit": "%", "scale": 100.0, "digits": 1}
_SPEED_ERROR = {"unit": "m/s", "digits": 2, "higher_is_better": False}
_LENGTH_ERROR = {"unit": "m", "digits": 2, "higher_is_better": False}
_AREA_ERROR = {"unit": "m^2", "digits": 2, "higher_is_better": False}


def _named(metrics: Iterable[Metric]) -> dict[str, Metric]:
    return {metric.name: metric for metric in metrics}


def _summary(prefix: str = "", of: str = "") -> list[Metric]:
    """The official summary; whole, or `of` a part of the data such as a range."""
    metrics = [
        Metric("mAP", "mAP", **PERCENT),
        Metric("NDS", "NDS", **PERCENT),
        Metric("mATE", "mATE", **_LENGTH_ERROR),
        Metric("mASE", "mASE", "1-IoU", higher_is_better=False),
        Metric("mAOE", "mAOE", "rad", higher_is_better=False),
        Metric("mAVE", "mAVE", **_SPEED_ERROR),
        Metric("mAAE", "mAAE", "1-acc", higher_is_better=False),
    ]
    return [replace(metric, name=prefix + metric.name, title=metric.title + of) for metric in metrics]


def _by_speed(speed: str) -> list[Metric]:
    """Scores of what moves at a speed."""
    prefix, of = f"speeds.{speed}.", f" {speed} m/s"
    return [
        Metric(f"{prefix}mAP_present", f"mAP{of}", **PERCENT),
        Metric(f"{prefix}mAVE_present", f"mAVE{of}", **_SPEED_ERROR),
        Metric(f"{prefix}mAP_normalized", f"normalised mAP{of}", **PERCENT),
        *(Metric(f"{prefix}{name}.AP", f"{_words(name)} AP{of}", **PERCENT) for name in CLASSES),
        *(Metric(f"{prefix}{name}.AP_normalized", f"normalised {_words(name)} AP{of}", **PERCENT) for name in CLASSES),
        Metric(f"{prefix}car.AVE", f"car AVE{of}", **_SPEED_ERROR),
    ]


def _words(name: str) -> str:
    return name.replace("_", " ")


def _detection_metrics() -> Iterator[Metric]:
    """The official score and its parts, what it does not see, and what a model costs."""
    yield from _summary()
    for part in RANGES:
        yield from _summary(f"ranges.{part}.", f" {part} m")
    yield from _summary("long_range.", ", long range")
    for part in LONG_RANGES:
        yield from _summary(f"long_range.ranges.{part}.", f" {part} m, long range")
    for name in CLASSES:
        yield Metric(f"classes.{name}.AP", f"{_words(name)} AP", **PERCENT)
        yield Metric(f"classes.{name}.AVE", f"{_words(name)} AVE", **_SPEED_ERROR)
    for speed in SPEEDS:
        yield from _by_speed(speed)
    yield Metric("measures.moving_AP", "AP of moving vehicles", **PERCENT)
    yield Metric("measures.moving_AP_normalized", "normalised AP of moving vehicles", **PERCENT)
    yield Metric("measures.moving_velocity_error", "velocity error of moving vehicles", **_SPEED_ERROR)
    yield Metric("measures.moving_radial_error", "radial velocity error of moving vehicles", **_SPEED_ERROR)
    yield Metric("measures.moving_heading_error", "heading error of moving vehicles", "deg", 1.0, 2, False)
    yield Metric("measures.hidden_recall", "recall of hidden objects", **PERCENT)
    yield Metric("measures.occupied_share", "objects with an occupied cell", **PERCENT)
    yield Metric("measures.head_share", "objects with a cell that the head sees", **PERCENT)
    for source in ("radar", "camera", "random"):
        yield Metric(f"measures.{source}_covers", f"objects that {source} Gaussians cover", **PERCENT)
    yield Metric("measures.remembered_share", "objects that history covers", **PERCENT)
    for source in SOURCES:
        key, movers = f"measures.{source}", "velocity error on movers"
        yield Metric(f"{key}_near", f"{source} Gaussians near an object", **PERCENT)
        yield Metric(f"{key}_faint", f"{source} Gaussians of opacity below 0.1", **PERCENT, higher_is_better=False)
        yield Metric(f"{key}_velocity_error", f"{source} Gaussians' {movers}", **_SPEED_ERROR)
        yield Metric(f"{key}_radial_error", f"{source} Gaussians' radial {movers}", **_SPEED_ERROR)
    for part in PARTS + FURTHER_PARTS:
        yield Metric(f"latency.{part}", _words(part), "ms", 1.0, 1, False)
    yield Metric("latency.fps", "frames per second", "1/s", 1.0, 2)
    yield Metric("latency.memory_gb", "memory", "GB", 1.0, 2, False)
    yield Metric("latency.gflop", "compute per frame", "GFLOP", 1.0, 1, False)
    yield Metric("cost.parameters", "parameters", "M", 1e-6, 2, False)
    yield Metric("cost.training", "training with its validation", "min", 1 / 60, 1, False)


_CHAMFERS = {
    "cd": "Chamfer",
    "nfcd": "Chamfer 0-50 m",
    "lfcd": "Chamfer 50-250 m",
    "cd_moving": "Chamfer of moving objects",
    "cd_unseen": "Chamfer of unseen space",
}
_RAY_ERRORS = {"l1": "L1 along rays", "l1_median": "median along rays"}


def _beside_static(key: str, words: str, unit: dict[str, Any]) -> list[Metric]:
    """An error of the forecast, and that of the world as it last stood."""
    return [Metric(key, words, **unit), Metric(f"static_{key}", f"static-world {words}", **unit)]


def _forecast_metrics() -> Iterator[Metric]:
    """Occupancy, forecast point clouds and velocities of a world model."""
    yield Metric("iou", "occupancy IoU along rays", **PERCENT)
    for horizon in ("1s", "3s"):
        for key, words in _CHAMFERS.items():
            yield from _beside_static(f"{key}_{horizon}", f"{words} {horizon}", _AREA_ERROR)
            gain = f"{words} {horizon} below the static-world baseline's"
            yield Metric(f"{key}_gain_{horizon}", gain, **PERCENT)
        for key, words in _RAY_ERRORS.items():
            yield from _beside_static(f"{key}_{horizon}", f"{words} {horizon}", _LENGTH_ERROR)
        for key, words in _RAY_ERRORS.items():
            for part in LONG_RANGES:
                name = f"{words} of {part} m {horizon}"
                yield from _beside_static(f"{key}_{part}m_{horizon}", name, _LENGTH_ERROR)
    for step in range(4):
        yield Metric(f"iou@{step}.0s", f"IoU along rays at {step} s", **PERCENT)
        yield Metric(f"slice_iou@{step}.0s", f"IoU above the ground at {step} s", **PERCENT)
        words = f"median radial velocity error of moving objects at {step} s"
        yield Metric(f"velocity_median_moving@{step}.0s", words, **_SPEED_ERROR)
    yield Metric("velocity_error_moving", "mean radial velocity error of moving objects", **_SPEED_ERROR)
    yield Metric("velocity_median_moving", "median radial velocity error of moving objects", **_SPEED_ERROR)
    yield Metric("velocity_error_standing", "mean radial velocity error of what stands", **_SPEED_ERROR)


def _forecast_metrics_by_time() -> Iterator[Metric]:
    for step in range(1, 4):
        for key, words in _CHAMFERS.items():
            yield from _beside_static(f"{key}@{step}.0s", f"{words} at {step} s", _AREA_ERROR)
        yield from _beside_static(f"l1@{step}.0s", f"{_RAY_ERRORS['l1']} at {step} s", _LENGTH_ERROR)


METRICS = _named(_detection_metrics())
FORECASTS = _named(_forecast_metrics())
"""Metrics of WORLD_TASKS, the tasks of a world model."""
FORECASTS_BY_TIME = _named(_forecast_metrics_by_time())
"""Further numbers of forecasting, of one time each; pages leave them to its picture."""
WORLD_TASKS = ("occupancy", "forecasting")


def metric_of(name: str) -> Metric:
    """The metric of this name; what has no name here is a plain number, larger being better."""
    return (METRICS | FORECASTS | FORECASTS_BY_TIME).get(name) or Metric(name, name)


def find_metric(name: str, where: str, task: str = DETECTION) -> Metric:
    """The metric of this name, among those of a task and what all cost.

    Of a task that has no names here an unknown one is a plain number, larger being better. Raises ConfigError naming
    `where` it stands and the nearest names there are.
    """
    known = METRICS | FORECASTS | FORECASTS_BY_TIME if task in WORLD_TASKS else METRICS
    if name in known:
        return known[name]
    if task not in (DETECTION, *WORLD_TASKS):
        return metric_of(name)
    near = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
    hint = f"did you mean {' or '.join(near)}?" if near else f"there are {', '.join(list(known)[:7])}, ..."
    raise ConfigError(f"{where}: {name} is not a metric; {hint}")
