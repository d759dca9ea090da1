"""Scores of a world model: occupancy and radial velocity, and forecasts of LiDAR beside the static-world baseline.

No annotation is read. What only a synthetic world knows, its true geometry, is compared with where there is any.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from src.data.datamodule import DetectionDataModule
from src.data.rays import TRUE_MARGIN_M
from src.data.schema import DatasetIndex
from src.data.timeline import TimelineConfig
from src.data.true_geometry import TRUTH_FOLDER, TrueGeometry
from src.errors import ConfigError
from src.geometry.bev_grid import BEVGrid
from src.geometry.bounds import farthest_m
from src.metrics.bootstrap import interval, intervals_of
from src.metrics.diagnostics import ratios
from src.metrics.forecast_text import format_forecast, format_occupancy
from src.metrics.forecasting import (
    HORIZONS_S,
    ForecastScores,
    forecast_sums,
    keep_common_frames,
    median_errors,
    score_forecast,
)
from src.metrics.static_world import static_world, unseen
from src.models.detector import Detector
from src.models.world_model import WorldModel
from src.pictures.world_picture import draw_horizons
from src.reliability.processes import gather_by_rank
from src.structures.batch import FrameBatch
from src.structures.ray_bundle import RayBundle
from src.structures.taxonomy import MOVING_MPS
from src.targets.occupancy_rays import FreePlaces, RaySampling, draw_rays, sample_queries
from src.training.evaluator import Evaluator
from src.training.ground_slice import GroundSlice, global_from_aug
from src.training.world_snapshots import draw_world

Array = np.ndarray

SAMPLING = RaySampling(
    min_free_m=1.5, depth_m=0.1, num_queries=4096, free_places=FreePlaces.along_rays, ray_balance=False
)
"""Places along rays that are asked for: as the paper's training draws them, fewer."""
SLICE_WINDOW, SLICE_CELL_M = ((-40.0, 40.0), (-40.0, 40.0)), 1.0
"""Where the true geometry is compared with, above the ground."""
SUBSETS = ("", "_moving", "_unseen")
STATIC = "static_"


@dataclass
class WorldScores:
    """What the scores of one sample are made of."""

    sums: dict[str, Array] = field(default_factory=dict)  # [2] total and count by number
    speed_errors: dict[int, Array] = field(default_factory=dict)  # by step: [n] m/s, of rays that end on moving objects
    forecasts: dict[str, ForecastScores] = field(default_factory=dict)  # by the prefix of their numbers

    def add(self, name: str, values: Tensor | Array, among: Tensor | Array) -> None:
        """Store total and count of `values` over those `among`, for their mean."""
        self.sums[name] = np.array([float(values[among].sum()), float(among.sum())])

    def add_iou(self, name: str, found: Tensor, truth: Tensor) -> None:
        """Store intersection and union, for their ratio."""
        self.sums[name] = np.array([float((found & truth).sum()), float((found | truth).sum())])


class OccupancyEvaluator(Evaluator):
    """Occupancy along the rays that came, and on a slice of the true geometry, by time; radial velocities.

    `iou@<t>s` is of places along rays, half of them occupied, `iou` of all times; `slice_iou@<t>s` of a lattice one
    metre above the ground, as far as the rays of the time tell of it. `velocity_error_moving`: mean of
    |predicted - true| m/s where rays end on moving objects, `velocity_median_moving` and
    `velocity_median_moving@<t>s` the median, over all times and of one.

    A sample that several processes saw counts once.
    """

    headline = "iou"
    monitored = ("iou",)
    labels: ClassVar[bool] = False
    logged: ClassVar[tuple[str, ...]] = ("iou", "velocity_error_moving", "velocity_median_moving")

    def __init__(self, index: DatasetIndex, timeline: TimelineConfig) -> None:
        self.index, self.timeline = index, timeline
        self.rows = {token: row for row, token in enumerate(index.sample_tokens.tolist())}
        self.scores_by_sample: dict[int, WorldScores] = {}  # by the sample's row in the index
        self.content: dict[str, Any] | None = None
        self._truth: tuple[int, TrueGeometry | None] | None = None  # of the scene asked for last, by its row

    @classmethod
    def of(cls, datamodule: DetectionDataModule) -> Self:
        """The evaluator of the validation frames that are read with rays. Raises ConfigError without a timeline."""
        timeline = datamodule.config.timeline
        if timeline is None or not datamodule.config.num_future_frames:
            raise ConfigError(
                "data.num_future_frames=0 or data.timeline=null: this phase learns from the rays of future LiDAR"
            )
        return cls(datamodule.index, timeline)

    def reset(self) -> None:
        """Forget what an earlier pass collected."""
        self.scores_by_sample.clear()

    def update(self, model: WorldModel, output: Any, batch: FrameBatch) -> None:
        """Score every sample of a batch."""
        rows = [self.rows[token] for token in batch.tokens]
        scores, parts = [WorldScores() for _ in rows], []
        for sample, (row, own) in enumerate(zip(rows, scores, strict=True)):
            generator = torch.Generator(batch.device).manual_seed(row)
            rays = (batch.rays.batch == sample) & (batch.rays.steps % self.timeline.score_stride == 0)
            rays, truth = batch.rays[rays], self._truth_of(row)
            parts.append(draw_rays(rays, model.bounds, self.timeline.scored_rays, generator))
            if truth is not None:
                self._score_slice(model, output, batch, sample, rays, truth, own)
        self._score(model, output, replace(batch, rays=RayBundle.concatenate(parts, dim=0)), rows, scores)
        for row, own in zip(rows, scores, strict=True):
            self.scores_by_sample.setdefault(row, own)

    def _score(
        self, model: WorldModel, output: Any, batch: FrameBatch, rows: list[int], scores: list[WorldScores]
    ) -> Tensor | None:  # [R] bool, rays that end on moving objects; None where nobody knows
        """Write what is found of each sample of `batch`, whose rays are thinned, into `scores`."""
        moving = torch.zeros(len(batch.rays), dtype=torch.bool)
        known = False
        for sample, (row, own) in enumerate(zip(rows, scores, strict=True)):
            among = batch.rays.batch == sample
            rays, truth = batch.rays[among], self._truth_of(row)
            self._score_occupancy(model, output, rays, own, row)
            speeds, moves = true_speeds(rays, batch, sample, truth)
            if moves is not None:
                known = True
                moving[among.cpu()] = moves
                self._score_velocity(model, output, rays, speeds, moves, own)
        return moving if known else None

    def _score_occupancy(self, model: WorldModel, output: Any, rays: RayBundle, scores: WorldScores, row: int) -> None:
        generator = torch.Generator(rays.ranges.device).manual_seed(row)
        queries = sample_queries(rays, model.bounds, SAMPLING, generator)
        at = torch.cat([queries.points, queries.times_s[:, None]], 1)
        if not len(at):
            return
        found = model.look_up(output, at, queries.batch)[0] > 0.5
        scores.add_iou("iou", found, queries.occupied)
        for step in queries.steps[queries.steps >= 0].unique().tolist():
            own = queries.steps == step
            scores.add_iou(f"iou@{step * self.timeline.interval_s:.1f}s", found[own], queries.occupied[own])

    def _score_slice(
        self,
        model: WorldModel,
        output: Any,
        batch: FrameBatch,
        sample: int,
        rays: RayBundle,  # of the sample, all that came
        truth: TrueGeometry,
        scores: WorldScores,
    ) -> None:
        places = GroundSlice.of(batch, sample, truth, model.bounds, SLICE_WINDOW, SLICE_CELL_M)
        for step in rays.steps.unique().tolist():
            time_s = step * self.timeline.interval_s
            told = torch.from_numpy(places.reached(rays[rays.steps == step]))
            solid = torch.from_numpy(places.solid(truth, time_s))
            found = model.look_up(output, *places.queries(time_s, batch.device))[0].cpu() > 0.5
            scores.add_iou(f"slice_iou@{time_s:.1f}s", found & told, solid & told)

    def _score_velocity(
        self, model: WorldModel, output: Any, rays: RayBundle, speeds: Tensor, moves: Tensor, scores: WorldScores
    ) -> None:
        inside = rays.points + 0.5 * SAMPLING.depth_m * rays.directions
        found = model.look_up(output, torch.cat([inside, rays.times_s[:, None]], 1), rays.batch)[1]
        if found is None:
            return
        errors, known = (found.cpu() - speeds).abs().nan_to_num(), ~speeds.isnan()
        scores.add("velocity_error_moving", errors, moves & known)
        scores.add("velocity_error_standing", errors, ~moves & known)
        for step in rays.steps.unique().tolist():
            scores.speed_errors[step] = errors[moves & known & (rays.steps.cpu() == step)].numpy()

    def _truth_of(self, row: int) -> TrueGeometry | None:
        scene = int(self.index.sample_scenes[row])
        if self._truth is None or self._truth[0] != scene:
            known = (self.index.root / TRUTH_FOLDER).is_dir()
            name = str(self.index.scene_names[scene])
            self._truth = scene, TrueGeometry.read(self.index.root, name) if known else None
        return self._truth[1]

    def compute(self) -> dict[str, float]:
        """The headline and the numbers of `logged`; `as_dict` then has all."""
        found: dict[int, WorldScores] = {}
        for of_rank in gather_by_rank(self.scores_by_sample):
            found = of_rank | found
        rows = sorted(found)
        names = sorted({name for row in rows for name in found[row].sums})
        sums = {name: np.stack([found[row].sums.get(name, np.zeros(2)) for row in rows]) for name in names}
        numbers = {name: float(values[0]) for name, values in self._ratios(sums, np.ones((1, len(rows)))).items()}
        numbers |= self._median_speed_errors([found[row].speed_errors for row in rows])
        for prefix in {prefix for row in rows for prefix in found[row].forecasts}:
            joined = ForecastScores.join([found[row].forecasts[prefix] for row in rows])
            medians = median_errors(joined, self.timeline.interval_s)
            numbers |= {f"{prefix}{name}": value for name, value in medians.items()}
        self.content = _plain(numbers) | {"intervals": self._intervals(sums, self.index.sample_scenes[rows])}
        shown = (name for name in (self.headline, *self.logged) if numbers.get(name) is not None)
        return {self.headline: float("nan")} | {name: numbers[name] for name in shown}

    def _median_speed_errors(self, by_sample: list[dict[int, Array]]) -> dict[str, float]:
        steps = sorted({step for errors in by_sample for step in errors})
        joined = {step: np.concatenate([errors[step] for errors in by_sample if step in errors]) for step in steps}
        named = {f"@{step * self.timeline.interval_s:.1f}s": errors for step, errors in joined.items()}
        named |= {"": np.concatenate([np.zeros(0), *joined.values()])}
        return {f"velocity_median_moving{time}": float(np.median(own)) for time, own in named.items() if len(own)}

    def _ratios(
        self,
        sums: Mapping[str, Array],  # [S, 2] each
        weights: Array,  # [R, S]
    ) -> dict[str, Array]:  # [R] each
        return ratios(sums, weights)

    def _intervals(self, sums: Mapping[str, Array], scenes: Array) -> dict[str, Any]:
        """95 % intervals of all ratios from drawing scenes anew with replacement, as for detections."""
        _, places = np.unique(scenes, return_inverse=True)

        def bounds(draws: Array) -> dict[str, list[float]]:
            drawn = self._ratios(sums, draws[:, places])
            return {name: found for name, values in drawn.items() if (found := interval(values)) is not None}

        return intervals_of(scenes, bounds)

    def as_dict(self) -> dict[str, Any]:
        """Every number by its name, null where undefined, and `intervals`."""
        return self.content

    def draw(self, folder: Path, title: str) -> None:
        """Scores by time and distance."""
        draw_horizons(folder / "horizons.png", self.content, title)

    def draw_frames(self, model: Detector, clips: list[list[FrameBatch]], grid: BEVGrid, folder: Path) -> None:
        """Draw what the model says (`draw_world`) beside the true geometry where it is known."""
        draw_world(model, clips, self._truth_by_token, self.timeline, folder)

    def _truth_by_token(self, token: str) -> TrueGeometry | None:
        return self._truth_of(self.rows[token])

    @staticmethod
    def describe(metrics: Mapping[str, Any]) -> str:
        """Occupancy scores by time, as text."""
        return format_occupancy(metrics)


class ForecastEvaluator(OccupancyEvaluator):
    """Also scores forecast LiDAR and, as `static_`, the forecast of a world that stands still.

    Names are those of `forecast_sums` and `median_errors`; `moving` and `unseen` are rays that end on moving
    objects, and where the input had not seen. A `gain` is the share by which a Chamfer distance lies below the static
    world's; both are over the frames in which both have points.
    Rays are thinned to `data.timeline.scored_rays`, so distances are larger than between whole clouds.
    """

    headline = "cd_gain_3s"
    monitored = ("cd_gain_3s", "cd_gain_1s", "iou")
    logged = (*("iou", "cd_1s", "cd_3s", "nfcd_3s", "lfcd_3s", "l1_3s"), *("cd_moving_gain_3s", "cd_unseen_gain_3s"))

    def _score(
        self, model: WorldModel, output: Any, batch: FrameBatch, rows: list[int], scores: list[WorldScores]
    ) -> Tensor | None:
        moving = super()._score(model, output, batch, rows, scores)
        future = batch.rays.steps > 0
        rays = batch.rays[future]
        subsets = {} if moving is None else {"moving": moving[future.cpu()]}
        if batch.lidar_origins is not None:
            subsets["unseen"] = unseen(replace(batch, rays=rays), model.bounds)
        found = {
            "": model.forecast(output, rays),
            STATIC: static_world(replace(batch, rays=rays), farthest_m(model.bounds)),
        }
        for sample, own in enumerate(scores):
            among = rays.batch == sample
            masks = {name: mask[among.cpu()] for name, mask in subsets.items()}
            own.forecasts = {
                prefix: score_forecast(rays[among], ranges[among], model.bounds, masks)
                for prefix, ranges in found.items()
            }
            keep_common_frames(*own.forecasts.values())
            for prefix, forecast in own.forecasts.items():
                sums = forecast_sums(forecast, self.timeline.interval_s)
                own.sums |= {f"{prefix}{name}": values for name, values in sums.items()}
        return moving

    def _ratios(self, sums: Mapping[str, Array], weights: Array) -> dict[str, Array]:
        found = ratios(sums, weights)
        for kind in (*(f"cd{subset}" for subset in SUBSETS), "nfcd", "lfcd"):
            for horizon in HORIZONS_S:
                own, static = (found.get(f"{prefix}{kind}_{horizon:g}s") for prefix in ("", STATIC))
                if own is not None and static is not None:
                    found[f"{kind}_gain_{horizon:g}s"] = 1 - own / static
        return found

    @staticmethod
    def describe(metrics: Mapping[str, Any]) -> str:
        """Forecast scores beside the static-world baseline's, then occupancy scores, as text."""
        return f"{format_forecast(metrics)}\n\n{format_occupancy(metrics)}"


def true_speeds(
    rays: RayBundle,
    batch: FrameBatch,
    sample: int,
    truth: TrueGeometry | None,
) -> tuple[Tensor, Tensor | None]:  # [R] m/s, [R] bool
    """Speeds over ground along rays of one sample, and which end on moving objects: true ones, else those measured.

    The second is None where nothing is known of any.
    """
    if truth is None:
        speeds = rays.speeds.cpu()
        return speeds, None if speeds.isnan().all() else speeds.abs() > MOVING_MPS
    matrix = global_from_aug(batch, sample)
    points = rays.points.double().cpu().numpy() @ matrix[:3, :3].T + matrix[:3, 3]
    times_s = float(batch.timestamps_s[sample]) + rays.times_s.double().cpu().numpy()
    velocities = truth.velocities(points, np.round(1e6 * times_s).astype(np.int64), TRUE_MARGIN_M)
    along = ((velocities @ matrix[:3, :3]) * rays.directions.double().cpu().numpy()).sum(1)
    return torch.from_numpy(along).float(), torch.from_numpy(np.linalg.norm(velocities, axis=1) > MOVING_MPS)


def _plain(numbers: Mapping[str, float]) -> dict[str, float | None]:
    return {name: None if np.isnan(value) else value for name, value in numbers.items()}
