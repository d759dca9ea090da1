"""Scores as tables for the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from src.metrics.bootstrap import LONG_RANGE
from src.metrics.scores import ERRORS

MEASURES = {
    "moving_AP": "AP of moving vehicles",
    "moving_AP_normalized": "normalised AP of moving vehicles",
    "hidden_recall": "recall of hidden objects, seen before",
    "occupied_share": "objects with an occupied cell",
    "head_share": "objects with a cell that the head sees",
    "radar_covers": "objects that radar Gaussians cover",
    "camera_covers": "objects that camera Gaussians cover",
    "random_covers": "objects that random Gaussians cover",
    "remembered_share": "objects that history covers",
}

IN_WORDS = {
    "mAP": "mAP",
    "NDS": "NDS",
    "classes.car.AP": "car AP",
    "measures.moving_AP": "AP of moving vehicles",
    f"{LONG_RANGE}.mAP": "mAP at long range",
}
"""Numbers whose intervals are shown, by their paths."""


def format_scores(metrics: Mapping[str, Any]) -> str:
    """Tables of the content of metrics.json: a summary by distance bin, every class by distance bin, the summary by a
    second protocol, speed classes, measures, how wrongly vehicles move.

    `metrics` is `DetectionScores.as_dict()`, fresh or read back; a file written before there were speed classes or
    measures has no table of them. mAP, NDS and AP in percent, errors in their own units (m, 1 - IoU, rad, m/s,
    1 - accuracy); "-" where a number is undefined. By speed, means are over the classes that have ground truth there;
    mAP_N is `mAP_normalized`.
    """
    parts = {"all": metrics} | metrics["ranges"]
    classes = [["class", "AP", *(f"AP {name}" for name in metrics["ranges"]), *ERRORS, "boxes"]]
    for name, overall in metrics["classes"].items():
        aps = [_percent(part["classes"][name]["AP"]) for part in parts.values()]
        classes.append([name, *aps, *(plain(overall[error]) for error in ERRORS), str(overall["num_gt"])])
    tables = [_summary("range (m)", metrics), classes]
    if LONG_RANGE in metrics:
        tables.append(_summary("long range (m)", metrics[LONG_RANGE]))
    if metrics.get("speeds"):
        tables.append(_speeds(metrics["speeds"]))
    measures = metrics.get("measures", {})
    if measures:
        tables.append(_measures(measures))
    if measures.get("radar_gaussians") is not None:
        tables.append(_gaussians(measures))
    return "\n\n".join([*map(align, tables), *_motion(measures), *_intervals(metrics.get("intervals", {"bounds": {}}))])


def _summary(corner: str, scores: Mapping[str, Any]) -> list[list[str]]:
    """Over everything and by distance."""
    rows = [[corner, "mAP", "NDS", *(f"m{name}" for name in ERRORS), "boxes"]]
    for name, part in ({"all": scores} | scores["ranges"]).items():
        errors = [plain(part[f"m{error}"]) for error in ERRORS]
        rows.append([name, _percent(part["mAP"]), _percent(part["NDS"]), *errors, _boxes(part)])
    return rows


def _intervals(intervals: Mapping[str, Any]) -> list[str]:
    """How sure the main numbers are, in a line; none of a single scene."""
    known = {words: intervals["bounds"].get(name) for name, words in IN_WORDS.items()}
    shown = [f"{words} {_percent(found[0])} to {_percent(found[1])}" for words, found in known.items() if found]
    return [f"95 % intervals over {intervals['scenes']} scenes: {', '.join(shown)}"] if shown else []


def _speeds(parts: Mapping[str, Any]) -> list[list[str]]:
    heads = ["speed (m/s)", "mAP", "mAP_N", *(f"m{name}" for name in ERRORS), "car AP", "car AVE"]
    rows = [[*heads, "classes", "boxes"]]
    for name, part in parts.items():
        errors = [plain(part[f"m{error}_present"]) for error in ERRORS]
        car, there = part["classes"]["car"], sum(values["num_gt"] > 0 for values in part["classes"].values())
        cars = [_percent(car["AP"]), plain(car["AVE"])] if car["num_gt"] else ["-", "-"]
        means = [_percent(part.get(f"mAP_{of}")) for of in ("present", "normalized")]  # older files lack the second
        rows.append([name, *means, *errors, *cars, str(there), _boxes(part)])
    return rows


def _measures(measures: Mapping[str, float | None]) -> list[list[str]]:
    rows = [["measure", "%", "boxes"]]
    for name, words in MEASURES.items():
        if name in measures:
            boxes = measures.get(f"{name.partition('_')[0]}_boxes")
            rows.append([words, _percent(measures[name]), "" if boxes is None else str(boxes)])
    return rows


def _motion(measures: Mapping[str, float | None]) -> list[str]:
    """How moving vehicles move, in a line; none where none is matched."""
    speed, radial, heading = (measures.get(f"moving_{name}_error") for name in ("velocity", "radial", "heading"))
    if speed is None or radial is None or heading is None:
        return []
    along = f"velocity off by {speed:.2f} m/s, {radial:.2f} along the ray, heading by {heading:.1f} deg"
    return [f"matched moving vehicles: {along}"]


def _gaussians(measures: Mapping[str, float | None]) -> list[list[str]]:
    rows = [["Gaussians", "per frame", "near an object, %", "opacity < 0.1, %", "velocity error of movers (m/s)"]]
    for source in (name.removesuffix("_gaussians") for name in measures if name.endswith("_gaussians")):
        number, wrong = measures[f"{source}_gaussians"], measures[f"{source}_velocity_error"]
        shares = [_percent(measures[f"{source}_{what}"]) for what in ("near", "faint")]
        rows.append([source, f"{number:.0f}", *shares, plain(wrong)])
    return rows


def _boxes(part: Mapping[str, Any]) -> str:
    return str(sum(values["num_gt"] for values in part["classes"].values()))


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f}"


def plain(value: float | None) -> str:
    """With three digits."""
    return "-" if value is None else f"{value:.3f}"


def align(rows: list[list[str]]) -> str:
    """Columns as wide as their widest cell, the first to the left; a line below the heads."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        cells = [row[0].ljust(widths[0])]
        cells += [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
        lines.append("  ".join(cells))
    lines.insert(1, "-" * len(lines[0]))
    return "\n".join(lines)
