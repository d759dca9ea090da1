"""Forecasts of LiDAR against the true points: Chamfer distance between clouds and errors along rays (lrs 7.2)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from src.geometry.bounds import Bounds
from src.geometry.neighbours import nearest_squared
from src.structures.ray_bundle import RayBundle

Array = np.ndarray

FIELDS_M = {"nfcd": (0.0, 50.0), "lfcd": (50.0, 250.0)}
"""Near and long field: points of either cloud at this distance from the ego (lrs 7.2, O28)."""
BINS_M = ((0.0, 50.0), (50.0, 150.0), (150.0, 250.0))
"""Of the errors along rays, by true range."""
HORIZONS_S = (1.0, 3.0)


def chamfer_distance(
    found: Array,  # [N, 3] m
    truth: Array,  # [M, 3] m
) -> float:
    """Half the mean squared distance to the nearest point of the other cloud, summed over both (lrs 7.2), m^2.

    NaN where a cloud is empty: there is no such distance, and the frame does not count.
    """
    if not (len(found) and len(truth)):
        return float("nan")
    return 0.5 * float(nearest_squared(found, truth).mean() + nearest_squared(truth, found).mean())


@dataclass(kw_only=True)
class ForecastScores:
    """Of F target frames and of their R rays."""

    steps: Array  # [F] int64, intervals of the timeline after the sample's frame
    chamfer: dict[str, Array]  # [F] m^2 each, NaN where not defined: cd, nfcd, lfcd, and cd_<subset>
    errors: Array  # [R] float32 m, |found - true range|
    ranges: Array  # [R] float32 m, true
    frames: Array  # [R] int64, row of the frame

    @classmethod
    def join(cls, parts: list[ForecastScores]) -> ForecastScores:
        """All frames of several samples, at least one; NaN for a subset that a sample does not know."""
        counts = np.cumsum([0, *(len(part.steps) for part in parts[:-1])])
        columns = {
            name: np.concatenate([getattr(part, name) for part in parts]) for name in ("steps", "errors", "ranges")
        }
        frames = np.concatenate([part.frames + count for part, count in zip(parts, counts, strict=True)])
        unknown = [np.full(len(part.steps), np.nan) for part in parts]
        chamfer = {
            name: np.concatenate([part.chamfer.get(name, none) for part, none in zip(parts, unknown, strict=True)])
            for name in dict.fromkeys(name for part in parts for name in part.chamfer)
        }
        return cls(**columns, chamfer=chamfer, frames=frames)


def score_forecast(
    rays: RayBundle,  # of one sample
    found: Tensor,  # [R] m, forecast ranges
    bounds: Bounds,
    subsets: Mapping[str, Tensor] | None = None,  # [R] bool by name: rays that are also compared among themselves
) -> ForecastScores:
    """Compare the ends of forecast rays, by the directions of the returns that came, with the ends of these.

    Clouds are cut to the bounds, and to near and long field, each by its own points; subsets are chosen by the ray.
    Errors are those of rays whose true end lies in the bounds.
    """
    truth = rays.points.double().cpu().numpy()
    forecast = (rays.origins + found.clamp(min=0)[:, None] * rays.directions).double().cpu().numpy()
    subsets = {f"cd_{name}": mask.cpu().numpy() for name, mask in (subsets or {}).items()}
    steps, frame = np.unique(rays.steps.cpu().numpy(), return_inverse=True)
    names = ("cd", *FIELDS_M, *subsets)
    chamfer = {name: np.full(len(steps), np.nan) for name in names}
    inside = {"found": _inside(forecast, bounds), "truth": _inside(truth, bounds)}
    away = {"found": np.linalg.norm(forecast, axis=1), "truth": np.linalg.norm(truth, axis=1)}
    clouds = {"found": forecast, "truth": truth}
    for row in range(len(steps)):
        own = frame == row
        for name in names:
            low, high = FIELDS_M.get(name, (0.0, np.inf))
            members = own & subsets[name] if name in subsets else own
            pair = (
                clouds[key][members & inside[key] & (away[key] >= low) & (away[key] < high)]
                for key in ("found", "truth")
            )
            chamfer[name][row] = chamfer_distance(*pair)
    kept = inside["truth"]
    return ForecastScores(
        steps=steps,
        chamfer=chamfer,
        errors=(found - rays.ranges).abs().float().cpu().numpy()[kept],
        ranges=rays.ranges.cpu().numpy()[kept],
        frames=frame[kept],
    )


def keep_common_frames(*forecasts: ForecastScores) -> None:
    """Keep, of each Chamfer distance, the frames in which every one of several forecasts of the same rays has one.

    Else a forecast would gain by losing all points of a frame that the others must answer for.
    """
    for name in forecasts[0].chamfer:
        values = [forecast.chamfer[name] for forecast in forecasts]
        lost = np.isnan(values).any(axis=0)
        for own in values:
            own[lost] = np.nan


def forecast_sums(scores: ForecastScores, interval_s: float) -> dict[str, Array]:  # [2] each
    """Total and count of every mean; a score is their ratio over all samples (`diagnostics.ratios`).

    `<cd>_<H>s`: over the frames up to the horizon H (O27); `<cd>@<t>s`: of the frames at t alone; `l1_<H>s`, `l1@<t>s`:
    over rays, and `l1_<low>-<high>m_<H>s` over those of that range.
    """
    sums: dict[str, Array] = {}
    times = {f"@{step * interval_s:.1f}s": scores.steps == step for step in np.unique(scores.steps).tolist()}
    for suffix, among in (_horizons(scores, interval_s) | times).items():
        for name, values in scores.chamfer.items():
            sums[f"{name}{suffix}"] = _total(values, among & ~np.isnan(values))
        rays = among[scores.frames]
        sums[f"l1{suffix}"] = _total(scores.errors, rays)
        if suffix not in times:
            for label, near in _bins(scores).items():
                sums[f"l1{label}{suffix}"] = _total(scores.errors, rays & near)
    return sums


def median_errors(scores: ForecastScores, interval_s: float) -> dict[str, float]:
    """`l1_median_<H>s` over the rays of the frames up to the horizon, `l1_median_<low>-<high>m_<H>s` over those of that
    range; NaN where there is none.
    """
    found = {}
    for suffix, among in _horizons(scores, interval_s).items():
        for label, near in ({"": np.ones(len(scores.errors), bool)} | _bins(scores)).items():
            errors = scores.errors[among[scores.frames] & near]
            found[f"l1_median{label}{suffix}"] = float(np.median(errors)) if len(errors) else float("nan")
    return found


def _horizons(scores: ForecastScores, interval_s: float) -> dict[str, Array]:  # [F] bool by suffix
    last = {horizon: round(horizon / interval_s) for horizon in HORIZONS_S}
    return {f"_{horizon:g}s": (scores.steps > 0) & (scores.steps <= step) for horizon, step in last.items()}


def _bins(scores: ForecastScores) -> dict[str, Array]:  # [R] bool by label
    return {f"_{low:g}-{high:g}m": (scores.ranges >= low) & (scores.ranges < high) for low, high in BINS_M}


def _total(values: Array, among: Array) -> Array:  # [2]
    return np.array([values[among].sum(dtype=np.float64), among.sum()])


def _inside(points: Array, bounds: Bounds) -> Array:  # [R] bool
    low, high = np.array(bounds).T
    return ((points >= low) & (points < high)).all(1)
