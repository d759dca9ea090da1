"""Scores of forecasts and of occupancy as tables for the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from src.metrics.score_text import align

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


def format_forecast(metrics: Mapping[str, Any]) -> str:
    """Each error over the frames up to a horizon, beside the static world's; "-" where there is none."""
    rows = [["", *(f"{name} {horizon}" for horizon in HORIZONS for name in ("forecast", "static"))]]
    for name, words in ROWS.items():
        names = [f"{prefix}{name}_{horizon}" for horizon in HORIZONS for prefix in ("", "static_")]
        if any(metrics.get(name) is not None for name in names):
            rows.append([words, *(_plain(metrics.get(name)) for name in names)])
    bounds, low_high = metrics["intervals"]["bounds"], []
    for horizon in HORIZONS:
        found = bounds.get(f"cd_gain_{horizon}")
        if found:
            low_high.append(f"{horizon} {100 * found[0]:.1f} to {100 * found[1]:.1f} %")
    sure = f"Chamfer below the static world's, 95 % over {metrics['intervals']['scenes']} scenes: {', '.join(low_high)}"
    return "\n\n".join([align(rows), *([sure] if low_high else [])])


def format_occupancy(metrics: Mapping[str, Any]) -> str:
    """Intersection over union by time, along rays and one metre above the ground; radial velocities."""
    times = sorted({name.partition("@")[2] for name in metrics if name.startswith("iou@")}, key=lambda t: float(t[:-1]))
    rows = [["time", "IoU along rays", "IoU above the ground"]]
    rows += [[time, *(_plain(metrics.get(f"{kind}@{time}")) for kind in ("iou", "slice_iou"))] for time in times]
    rows.append(["all", _plain(metrics.get("iou")), ""])
    names = {"velocity_error_moving": "mean", "velocity_median_moving": "median"}
    speeds = [f"{words} {_plain(metrics[name])}" for name, words in names.items() if metrics.get(name) is not None]
    text = f"radial velocity error of what moves, m/s: {', '.join(speeds)}"
    return "\n\n".join([align(rows), *([text] if speeds else [])])


def _plain(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
