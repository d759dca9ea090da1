"""The numbers that tables and sweeps may name: meaning, unit, direction. Imports no torch."""

from __future__ import annotations

import difflib
from dataclasses import dataclass

from src.errors import ConfigError
from src.structures.taxonomy import CLASSES, SOURCES

DETECTION = "detection"
"""The task (`phase.task`) whose numbers have names here."""
RANGES = ("0-25", "25-50", "50-100", "100-150")
LONG_RANGES = ("0-50", "50-150", "150-250")
"""Of the second score of detections (`phase.long_range`)."""
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


def _summary(prefix: str = "", title: str = "") -> dict[str, Metric]:
    """The official summary; whole, or of a part of the data such as a range."""
    rows = [("mAP", "%", 100.0, 1, True), ("NDS", "%", 100.0, 1, True)]
    rows += [("mATE", "m", 1.0, 2, False), ("mASE", "1-IoU", 1.0, 3, False), ("mAOE", "rad", 1.0, 3, False)]
    rows += [("mAVE", "m/s", 1.0, 2, False), ("mAAE", "1-acc", 1.0, 3, False)]
    return {prefix + name: Metric(prefix + name, name + title, *rest) for name, *rest in rows}


METRICS = _summary()
for _range in RANGES:
    METRICS |= _summary(f"ranges.{_range}.", f" {_range} m")
METRICS |= _summary("long_range.", ", long range")
for _range in LONG_RANGES:
    METRICS |= _summary(f"long_range.ranges.{_range}.", f" {_range} m, long range")
for _class in CLASSES:
    for _error, *_rest in (("AP", "%", 100.0, 1, True), ("AVE", "m/s", 1.0, 2, False)):
        _name = f"classes.{_class}.{_error}"
        METRICS[_name] = Metric(_name, f"{_class} {_error}".replace("_", " "), *_rest)
for _speed in SPEEDS:
    for _key, _words, *_rest in (
        ("mAP_present", "mAP", "%", 100.0, 1, True),
        ("mAVE_present", "mAVE", "m/s", 1.0, 2, False),
        ("mAP_normalized", "normalised mAP", "%", 100.0, 1, True),
        *((f"{name}.AP", f"{name} AP".replace("_", " "), "%", 100.0, 1, True) for name in CLASSES),
        *(
            (f"{name}.AP_normalized", f"normalised {name} AP".replace("_", " "), "%", 100.0, 1, True)
            for name in CLASSES
        ),
        ("car.AVE", "car AVE", "m/s", 1.0, 2, False),
    ):
        METRICS[f"speeds.{_speed}.{_key}"] = Metric(f"speeds.{_speed}.{_key}", f"{_words} {_speed} m/s", *_rest)
for _key, _words, *_rest in (
    ("moving_AP", "AP of moving vehicles", "%", 100.0, 1, True),
    ("moving_AP_normalized", "normalised AP of moving vehicles", "%", 100.0, 1, True),
    ("moving_velocity_error", "velocity error of moving vehicles", "m/s", 1.0, 2, False),
    ("moving_radial_error", "radial velocity error of moving vehicles", "m/s", 1.0, 2, False),
    ("moving_heading_error", "heading error of moving vehicles", "deg", 1.0, 2, False),
    ("hidden_recall", "recall of hidden objects", "%", 100.0, 1, True),
    ("occupied_share", "objects with an occupied cell", "%", 100.0, 1, True),
    ("head_share", "objects with a cell that the head sees", "%", 100.0, 1, True),
    ("radar_covers", "objects that radar Gaussians cover", "%", 100.0, 1, True),
    ("camera_covers", "objects that camera Gaussians cover", "%", 100.0, 1, True),
    ("random_covers", "objects that random Gaussians cover", "%", 100.0, 1, True),
    ("remembered_share", "objects that history covers", "%", 100.0, 1, True),
):
    METRICS[f"measures.{_key}"] = Metric(f"measures.{_key}", _words, *_rest)
for _source in SOURCES:
    for _key, _words, *_rest in (
        ("near", "Gaussians near an object", "%", 100.0, 1, True),
        ("faint", "Gaussians of opacity below 0.1", "%", 100.0, 1, False),
        ("velocity_error", "Gaussians' velocity error on movers", "m/s", 1.0, 2, False),
        ("radial_error", "Gaussians' radial velocity error on movers", "m/s", 1.0, 2, False),
    ):
        METRICS[f"measures.{_source}_{_key}"] = Metric(f"measures.{_source}_{_key}", f"{_source} {_words}", *_rest)
for _part in PARTS + FURTHER_PARTS:
    METRICS[f"latency.{_part}"] = Metric(f"latency.{_part}", _part.replace("_", " "), "ms", 1.0, 1, False)
METRICS["latency.fps"] = Metric("latency.fps", "frames per second", "1/s", 1.0, 2, True)
METRICS["latency.memory_gb"] = Metric("latency.memory_gb", "memory", "GB", 1.0, 2, False)
METRICS["latency.gflop"] = Metric("latency.gflop", "compute per frame", "GFLOP", 1.0, 1, False)
METRICS["cost.parameters"] = Metric("cost.parameters", "parameters", "M", 1e-6, 2, False)
METRICS["cost.training"] = Metric("cost.training", "training with its validation", "min", 1 / 60, 1, False)

FORECASTS = {"iou": Metric("iou", "occupancy IoU along rays", "%", 100.0, 1)}
"""Of WORLD_TASKS, those of a world model."""
WORLD_TASKS = ("occupancy", "forecasting")
_CHAMFERS = (
    ("cd", "Chamfer"), ("nfcd", "Chamfer 0-50 m"), ("lfcd", "Chamfer 50-250 m"),
    ("cd_moving", "Chamfer of moving objects"), ("cd_unseen", "Chamfer of unseen space"),
)  # fmt: skip
for _horizon in ("1s", "3s"):
    for _key, _words in _CHAMFERS:
        for _prefix, _of in (("", ""), ("static_", "static-world ")):
            _name = f"{_prefix}{_key}_{_horizon}"
            FORECASTS[_name] = Metric(_name, f"{_of}{_words} {_horizon}", "m^2", 1.0, 2, False)
        _name = f"{_key}_gain_{_horizon}"
        FORECASTS[_name] = Metric(_name, f"{_words} {_horizon} below the static-world baseline's", "%", 100.0, 1)
    for _key, _words in (
        ("l1", "L1 along rays"), ("l1_median", "median along rays"),
        *((f"l1_{_range}m", f"L1 along rays of {_range} m") for _range in LONG_RANGES),
        *((f"l1_median_{_range}m", f"median along rays of {_range} m") for _range in LONG_RANGES),
    ):  # fmt: skip
        for _prefix, _of in (("", ""), ("static_", "static-world ")):
            _name = f"{_prefix}{_key}_{_horizon}"
            FORECASTS[_name] = Metric(_name, f"{_of}{_words} {_horizon}", "m", 1.0, 2, False)
for _step in range(4):
    for _key, _words in (("iou", "IoU along rays"), ("slice_iou", "IoU above the ground")):
        _name = f"{_key}@{_step}.0s"
        FORECASTS[_name] = Metric(_name, f"{_words} at {_step} s", "%", 100.0, 1)
    _name, _words = f"velocity_median_moving@{_step}.0s", "median radial velocity error of moving objects"
    FORECASTS[_name] = Metric(_name, f"{_words} at {_step} s", "m/s", 1.0, 2, False)
for _key, _words in (
    ("velocity_error_moving", "mean radial velocity error of moving objects"),
    ("velocity_median_moving", "median radial velocity error of moving objects"),
    ("velocity_error_standing", "mean radial velocity error of what stands"),
):
    FORECASTS[_key] = Metric(_key, _words, "m/s", 1.0, 2, False)

FORECASTS_BY_TIME: dict[str, Metric] = {}
"""Further numbers of forecasting, of one time each; pages leave them to its picture."""
for _step in range(1, 4):
    for _key, _words in (*_CHAMFERS, ("l1", "L1 along rays")):
        for _prefix, _of in (("", ""), ("static_", "static-world ")):
            _name, _unit = f"{_prefix}{_key}@{_step}.0s", "m" if _key == "l1" else "m^2"
            FORECASTS_BY_TIME[_name] = Metric(_name, f"{_of}{_words} at {_step} s", _unit, 1.0, 2, False)


def find_metric(name: str, where: str, task: str = DETECTION) -> Metric:
    """The metric of this name, among those of a task and what all cost.

    Of a task that has no names here an unknown one is a plain number, larger being better. Raises ConfigError naming
    `where` it stands and the nearest names there are.
    """
    known = METRICS | FORECASTS | FORECASTS_BY_TIME if task in WORLD_TASKS else METRICS
    if name in known:
        return known[name]
    if task not in (DETECTION, *WORLD_TASKS):
        return Metric(name, name)
    near = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
    hint = f"did you mean {' or '.join(near)}?" if near else f"there are {', '.join(list(known)[:7])}, ..."
    raise ConfigError(f"{where}: {name} is not a metric; {hint}")
