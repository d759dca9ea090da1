"""Scores as tables for the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from src.metrics.scores import ERRORS


def format_scores(metrics: Mapping[str, Any]) -> str:
    """Tables of the content of metrics.json: a summary by distance bin, then every class with its AP by distance bin.

    `metrics` is `DetectionScores.as_dict()`, fresh or read back. mAP, NDS and AP in percent, errors in their own
    units (m, 1 - IoU, rad, m/s, 1 - accuracy); "-" where a number is undefined.
    """
    parts = {"all": metrics} | metrics["ranges"]
    summary = [["range (m)", "mAP", "NDS", *(f"m{name}" for name in ERRORS), "boxes"]]
    for name, part in parts.items():
        errors = [_plain(part[f"m{error}"]) for error in ERRORS]
        boxes = sum(of_class["num_gt"] for of_class in part["classes"].values())
        summary.append([name, _percent(part["mAP"]), _percent(part["NDS"]), *errors, str(boxes)])
    classes = [["class", "AP", *(f"AP {name}" for name in metrics["ranges"]), *ERRORS, "boxes"]]
    for name, overall in metrics["classes"].items():
        aps = [_percent(part["classes"][name]["AP"]) for part in parts.values()]
        classes.append([name, *aps, *(_plain(overall[error]) for error in ERRORS), str(overall["num_gt"])])
    return _align(summary) + "\n\n" + _align(classes)


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f}"


def _plain(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _align(rows: list[list[str]]) -> str:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        cells = [row[0].ljust(widths[0])]
        cells += [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
        lines.append("  ".join(cells))
    lines.insert(1, "-" * len(lines[0]))
    return "\n".join(lines)
