"""Pictures of what a world model says, for some validation frames: slices of occupancy, forecasts, and a film."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from src.data.timeline import TimelineConfig
from src.data.true_geometry import TrueGeometry
from src.geometry.bounds import farthest_m
from src.metrics.static_world import static_world
from src.models.world_model import WorldModel
from src.pictures.film import Film
from src.pictures.world_picture import (
    WINDOW,
    ForecastMoment,
    OccupancySlice,
    draw_forecast,
    draw_slices,
)
from src.structures.batch import FrameBatch
from src.targets.occupancy_rays import draw_rays
from src.training.ground_slice import HEIGHT_M, GroundSlice
from src.training.snapshots import last_outputs

SLICES_S = (0.0, 1.0, 2.0, 3.0)
SLICE_CELL_M = 0.5
SHOWN_RAYS = 2048
"""Most rays shown of a moment; a film has fewer, as it has many moments."""
FILM_RAYS = 1024


@torch.no_grad()
def draw_world(
    model: WorldModel,  # a detector as well
    clips: Sequence[list[FrameBatch]],  # of batches of one; the last frames have rays
    truth_of: Callable[[str], TrueGeometry | None],  # by the sample's token
    timeline: TimelineConfig,
    folder: Path,
) -> list[Path]:
    """PNGs of the last frame of each clip. Returns the paths.

    `occupancy_*`: slices above the ground at up to four times. Of a model that forecasts also `forecast_*`: after one
    second and at the horizon, beside the baseline and the true points; and of the first clip all moments as a film,
    `film_*`, an animated PNG.
    """
    paths = []
    for name, batch, output in last_outputs(model, clips):
        title = f"Sample {batch.tokens[0][:12]}"
        paths.append(folder / f"occupancy_{name}")
        times_s = [time_s for time_s in SLICES_S if time_s <= timeline.horizon_s]
        slices = [_slice(model, output, batch, truth_of(batch.tokens[0]), time_s) for time_s in times_s]
        draw_slices(paths[-1], slices, title, HEIGHT_M)
        if not model.forecasts:
            continue
        last = timeline.last_step
        steps = sorted({min(round(1.0 / timeline.interval_s), last), last})
        moments = list(_moments(model, output, batch, steps, SHOWN_RAYS, timeline.interval_s))
        paths.append(folder / f"forecast_{name}")
        draw_forecast(paths[-1], moments, title)
        if name.startswith("0_"):
            every = range(1, last + 1)
            paths.append(folder / f"film_{name}")
            _write_film(paths[-1], _moments(model, output, batch, every, FILM_RAYS, timeline.interval_s), title)
    return paths


def _slice(
    model: WorldModel, output: Any, batch: FrameBatch, truth: TrueGeometry | None, time_s: float
) -> OccupancySlice:
    (right, ahead), cell_m = WINDOW, SLICE_CELL_M
    places = GroundSlice.of(batch, 0, truth, model.bounds, (ahead, (-right[1], -right[0])), cell_m)
    occupancy, speeds = model.look_up(output, *places.queries(time_s, batch.device))
    return OccupancySlice(
        time_s=time_s,
        points=places.in_aug[:, :2].numpy(),
        cell_m=cell_m,
        occupancy=occupancy.cpu().numpy(),
        speeds=None if speeds is None else speeds.cpu().numpy(),
        solid=None if truth is None else places.solid(truth, time_s),
    )


def _moments(
    model: WorldModel, output: Any, batch: FrameBatch, steps: Sequence[int], count: int, interval_s: float
) -> Iterator[ForecastMoment]:
    """Forecasts of those `steps` that have rays; at most `count` rays each, the same at every call."""
    for step in steps:
        generator = torch.Generator(batch.device).manual_seed(step)
        rays = draw_rays(batch.rays[batch.rays.steps == step], model.bounds, count, generator)
        if len(rays):
            static = static_world(replace(batch, rays=rays), farthest_m(model.bounds))
            values = (rays.origins, rays.directions, rays.ranges, model.forecast(output, rays), static)
            yield ForecastMoment(step * interval_s, *(value.cpu().numpy() for value in values))


def _write_film(path: Path, moments: Iterable[ForecastMoment], title: str) -> None:
    film = Film()
    for moment in moments:
        film.add(partial(draw_forecast, moments=[moment], title=title), moment.time_s)
    if film:
        film.write_animation(path)
