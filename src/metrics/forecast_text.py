"""Scores of forecasts and of occupancy as tables for the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from src.metrics.score_text import align, plain

ROWS = {
    "cd": "Chamfer, m^2",
    "nfcd": "Chamfer 0-50 m",
    "lfcd": "Chamfer 50-250 m",
    "cd_moving": "Chamfer, moving",
    "cd_unseen": "Chamfer, unseen",
    "l1": "L1 along rays, m",
    "l1_median": "median along rays, m",
    "l1_0-50m": "L1 0-50 m",
    "l1_50-150m": "L1 50-150 m",
    "l1_150-250m": "L1 150-250 m",
}
HORIZONS = ("1s", "3s")
OCCUPANCY = {
    "iou": "IoU along rays",
    "slice_iou": "IoU above the ground",
    "velocity_median_moving": "median error of radial velocities of moving objects, m/s",
    "velocity_error_moving": "mean error, m/s",
}


def format_forecast(metrics: Mapping[str, Any]) -> str:
    """Each error over the frames up to a horizon, beside the static-world baseline's and how far below it; "-" where
    there is none. In brackets 95 % intervals over scenes.
    """
    rows = [["", *(f"{name} {horizon}" for horizon in HORIZONS for name in ("forecast", "static", "below, %"))]]
    for name, words in ROWS.items():
        cells = []
        for horizon in HORIZONS:
            cells += [plain(metrics.get(f"{prefix}{name}_{horizon}")) for prefix in ("", "static_")]
            cells.append(_gain(metrics, f"{name}_gain_{horizon}"))
        if any(cell not in ("-", "") for cell in cells):
            rows.append([words, *cells])
    return align(rows)


def format_occupancy(metrics: Mapping[str, Any]) -> str:
    """By time intersection over union, along rays and one metre above the ground, and errors of radial velocities."""
    times = sorted({name.partition("@")[2] for name in metrics if name.startswith("iou@")}, key=lambda t: float(t[:-1]))
    kinds = {kind: words for kind, words in OCCUPANCY.items() if kind.endswith("iou") or metrics.get(kind) is not None}
    rows = [["time", *kinds.values()]]
    rows += [[time, *(plain(metrics.get(f"{kind}@{time}")) for kind in kinds)] for time in times]
    rows.append(["all", *(plain(metrics.get(kind)) for kind in kinds)])
    return align(rows)


def _gain(metrics: Mapping[str, Any], name: str) -> str:
    """In percent; empty for an error that has none."""
    value, bounds = metrics.get(name), metrics["intervals"]["bounds"].get(name)
    if value is None:
        return ""
    sure = f" [{100 * bounds[0]:.1f}, {100 * bounds[1]:.1f}]" if bounds else ""
    return f"{100 * value:.1f}{sure}"
