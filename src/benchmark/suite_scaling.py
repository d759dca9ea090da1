"""suite=scaling: cost of a frame as range, traffic, radar, Gaussians and memory grow, beside the dense baseline."""

from __future__ import annotations

import copy
import logging
import statistics
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from src.benchmark.cases import (
    CANDIDATES,
    CELLS_PER_VEHICLE,
    KEY_FRAME_S,
    OCCUPIED_CELLS,
    Case,
    build_case,
    expect_trained_occupancy,
    expect_trained_scores,
    later,
)
from src.benchmark.counting import counted_work
from src.benchmark.page import gpu_notes, page_name
from src.benchmark.parts import is_within, parts_of, tensors_in
from src.benchmark.plots import draw_scaling, held_mib
from src.benchmark.scenes import ROADS, Highway, highway_frame, highway_points, lidar_frame
from src.benchmark.timing import added_mib, clock, interleaved, milliseconds, timed_parts
from src.config import Config, compose_config
from src.models.detector import ModelConfig
from src.structures.batch import FrameBatch
from src.training.phases import EVALUATORS

logger = logging.getLogger(__name__)

BASELINE = "dense_bev"
ROUNDS, BUDGET_S = 5, 24.0  # of each model at each point; where frames take longer than 5 s there are fewer rounds
NOMINAL_M = 150.0  # the range of the paper: `grid.cells` cover it
EGO_STEP_M = 12.0  # between remembered frames: 24 m/s
FIXED_REACH_M = 150.0  # the one fixed scene ends here, whatever the grid covers
FACTORS = {
    "objects": (0.0, 0.5, 1.0, 2.0, 4.0),
    "radar points": (0.25, 0.5, 1.0, 2.0),
    "gaussians": (0.25, 0.5, 1.0, 2.0),
}
MEMORY_FRAMES = (0, 1, 2, 4, 8)
RANGES_M = {
    "paper": (75.0, 150.0, 300.0, 600.0),
    "mini": (75.0, 150.0, 300.0, 600.0),
    "debug": (75.0, 150.0, 300.0),
}


LIDAR_RANGES_M = (100.0, 200.0, 300.0)
"""Ranges for a model that reads LiDAR; its one scene ends at the first."""
FIXED_SCENE, CALIBRATED_SCENE = "range, fixed scene", "range, calibrated scene"
PRUNED = (0, 50)  # % of voxels, in the calibrated scene


@dataclass(frozen=True)
class Point:
    """One setting of one sweep; what is not varied is nominal."""

    x: float
    range_m: float
    road: Highway
    gaussians: float = 1.0  # factor on the keypoints of all kinds
    memory_frames: int | None = None  # None: as configured
    occupied_cells: int | None = None  # by Gaussians; None: what fresh weights occupy
    pruning_ratio: float | None = None  # of a radar encoder that can prune; None: as configured


def measure(config: Config, tree: dict[str, Any]) -> dict[str, Any]:
    """Time and memory of a frame without its image encoder, at every point of every sweep; growth first."""
    device = config.trainer.device()
    configs = configs_of(config)
    road = ROADS[config.scale]
    if reads_lidar(config):
        sweeps = {FIXED_SCENE: [Point(r, r, replace(road, reach_m=LIDAR_RANGES_M[0])) for r in LIDAR_RANGES_M]}
    else:
        sweeps = sweeps_of(road, RANGES_M[config.scale], config.phase.temporal, OCCUPIED_CELLS[config.scale])
    measured = {name: measure_sweep(name, points, configs, device) for name, points in sweeps.items()}
    result = {
        "notes": [*notes_of(config, device), *gpu_notes(device)],
        "picture": None,
        "growth": growth_rows(measured),
    }
    if config.out:
        name = f"{page_name(config)}.png"
        draw_scaling(
            Path(config.out) / name,
            measured,
            f"Cost of a frame without its image encoder, scale {config.scale}",
            FIXED_SCENE,
        )
        result["picture"] = name
    return result | measured


def notes_of(config: Config, device: torch.device) -> list[str]:
    """What was measured, and on what scenes."""
    measured = (
        f"Scale {config.scale}, {config.phase.name}, {config.precision} on {device}, batch 1, the models as "
        "prediction prepares them, with fresh weights{}. {}. Medians; ± is the interquartile range. `added` "
        "is the most memory that a frame takes beyond inputs and weights, `remembered` waits for the next one."
    )
    asked = f" {CANDIDATES} cells pass the score threshold, as of trained models; fresh weights alone would pass half."
    if reads_lidar(config):
        scene = f"Voxels stay as they are, so a longer range has more; the scene ends at {LIDAR_RANGES_M[0]:g} m"
        if not EVALUATORS[config.phase.task].labels:
            asked = " A frame also answers where its rays end."
        return [measured.format("", scene) + asked]
    cells = "The cell stays 0.8 m, so a longer range has more cells"
    return [
        measured.format(", from features that the image encoder has made already", cells) + asked,
        "range, equal density: the road goes on to the end of the range. range, fixed scene: the road ends at "
        f"{FIXED_REACH_M:g} m. Only these two have anything beyond {NOMINAL_M:g} m. range, calibrated scene: the same, "
        f"and Gaussians occupy {OCCUPIED_CELLS[config.scale]} cells as trained ones do; of fresh weights they fill the "
        "map. pruned voxels: there, `model.radar_encoder.pruning_ratio`. A remembered frame holds "
        f"{CELLS_PER_VEHICLE[config.scale]} cells a vehicle and the Gaussians that are configured for it, or, in a "
        "dense model, its whole map.",
    ]


def reads_lidar(config: Config) -> bool:
    """Whether the model reads LiDAR. It is then measured alone: traffic, radar and Gaussians do not concern it."""
    return "lidar" in config.model.sensors


def points_of(batch: FrameBatch) -> dict[str, Tensor]:
    """Points of each sensor that a made frame has, by the sensor's name."""
    found = {"radar": batch.radar_points, "lidar": batch.lidar_points}
    return {name: points for name, points in found.items() if points is not None}


def configs_of(config: Config) -> dict[str, Config]:
    """The configured model with fresh weights, then the dense baseline at its scale, grid and backbone; by name.

    All methods side by side, at one range: `suite=latency`, and sweeps/comparison.yaml.
    """
    configs = {config.model.name: replace(config, checkpoint=None)}
    if not reads_lidar(config) and BASELINE not in configs:
        same = {name: getattr(config, name) for name in ("grid", "backbone", "precision", "seed")}
        overrides = [f"model={BASELINE}", f"scale={config.scale}", f"phase={config.phase.name}", "data=synthetic"]
        configs[BASELINE] = replace(compose_config(overrides)[0], **same)
    return configs


def sweeps_of(
    road: Highway,  # at the nominal range
    ranges_m: tuple[float, ...],
    temporal: bool,
    occupied_cells: int,  # of the calibrated scene
) -> dict[str, list[Point]]:
    """The points of every sweep; what is nominal in several of them is measured in each."""
    fixed = replace(road, reach_m=FIXED_REACH_M)

    def vehicles(factor: float) -> Highway:
        return replace(road, num_vehicles=round(factor * road.num_vehicles))

    def returns(factor: float) -> Highway:
        return replace(
            road,
            background=round(factor * road.background),
            points_per_vehicle=max(1, round(factor * road.points_per_vehicle)),
        )

    returned = [returns(factor) for factor in FACTORS["radar points"]]
    sweeps = {
        "range, equal density": [Point(r, r, replace(road, reach_m=r)) for r in ranges_m],
        FIXED_SCENE: [Point(r, r, fixed) for r in ranges_m],
        CALIBRATED_SCENE: [Point(r, r, fixed, occupied_cells=occupied_cells) for r in ranges_m],
        "pruned voxels, %": [
            Point(percent, NOMINAL_M, fixed, occupied_cells=occupied_cells, pruning_ratio=0.01 * percent)
            for percent in PRUNED
        ],
        "objects": [Point(vehicles(f).num_vehicles, NOMINAL_M, vehicles(f)) for f in FACTORS["objects"]],
        "radar points": [Point(len(highway_points(scene)), NOMINAL_M, scene) for scene in returned],
        "gaussians": [Point(f, NOMINAL_M, road, gaussians=f) for f in FACTORS["gaussians"]],
    }
    if temporal:
        sweeps["memory frames"] = [Point(n, NOMINAL_M, road, memory_frames=n) for n in MEMORY_FRAMES]
    return sweeps


def measure_sweep(
    name: str, points: list[Point], configs: dict[str, Config], device: torch.device
) -> list[dict[str, Any]]:
    """A row for each point and model."""
    rows = []
    for number, point in enumerate(points, 1):
        logger.info("%s: point %d of %d", name, number, len(points))
        made = {model: case_at(config, point, device) for model, config in configs.items()}
        cases = {model: case for model, (case, _) in made.items()}
        x = max(gaussians for _, gaussians in made.values()) if name == "gaussians" else point.x
        seconds, parts = measure_cases(cases)
        for model, case in cases.items():
            row = {name: int(x), "model": model, **milliseconds(seconds[model])}
            row["added MiB"] = added_mib(case.infer, device)
            row["remembered MiB"] = sum(x.nbytes for x in tensors_in(case.memory)) / 2**20
            with counted_work() as work:
                case.infer()
            row["GFLOP"] = work.flops / 1e9
            row |= {f"{name} points": len(points) for name, points in points_of(case.batch).items()}
            rows.append(row | {f"{part} ms": 1e3 * statistics.median(values) for part, values in parts[model].items()})
        del made, cases
    return rows


def measure_cases(cases: dict[str, Case]) -> tuple[dict[str, list[float]], dict[str, dict[str, list[float]]]]:
    """Seconds of a frame and of its parts, the models in turns; the frame is timed with its parts' clocks running."""
    parts: dict[str, dict[str, list[float]]] = {model: {} for model in cases}
    now = clock(next(iter(cases.values())).device)

    def timed(model: str, case: Case) -> Callable[[], None]:
        paths = {
            name: paths
            for name, paths in parts_of(case.prepared).items()
            if not is_within(name) and name != "image_encoder"
        }

        def run() -> None:
            with timed_parts(case.prepared, paths, now) as seconds:
                case.infer()
            for name, value in seconds.items():
                parts[model].setdefault(name, []).append(value)

        return run

    candidates = {model: timed(model, case) for model, case in cases.items()}
    seconds = interleaved(candidates, now, ROUNDS, BUDGET_S)
    for model, found in parts.items():  # without the first call, which warms up and is not in `seconds`
        parts[model] = {name: values[-len(seconds[model]) :] for name, values in found.items()}
    return seconds, parts


def case_at(config: Config, point: Point, device: torch.device) -> tuple[Case, int]:
    """A model on a grid of this range, with a full memory of frames that saw the same road a little behind.

    Also how many Gaussians it has without memory.
    """
    torch.manual_seed(config.seed)
    settings = settings_at(config, point)
    cells = [round(number * point.range_m / NOMINAL_M) for number in config.grid.cells]
    if reads_lidar(config):
        batch = lidar_frame(point.road)
    else:
        batch = highway_frame(highway_points(point.road), tuple(config.backbone.image_size_px))
    case = build_case(replace(config, model=settings, grid=replace(config.grid, cells=cells)), batch.to(device), device)
    encoder = getattr(case.prepared, "image_encoder", None)
    if encoder is not None:  # it gives the same features every time, without encoding again
        with torch.no_grad(), case.computing():
            features = encoder(case.batch.images)
        encoder.forward = lambda images: features
    output, memory = expect_trained_scores(case)
    if settings.memory_frames:
        fill_from_behind(case, memory, settings.memory_frames)
    if point.occupied_cells is not None:
        expect_trained_occupancy(case, point.occupied_cells)
    gaussians = case.prepared.evidence(output).gaussians
    return case, 0 if gaussians is None else int(gaussians.valid.sum())


def settings_at(config: Config, point: Point) -> ModelConfig:
    """The model's settings at a point, with as many remembered cells as its traffic fills."""
    vehicles = max(1, round(point.road.num_vehicles * point.road.reach_m / NOMINAL_M))
    cells = vehicles * CELLS_PER_VEHICLE[config.scale]
    settings = config.model.scaled(point.gaussians, point.memory_frames, cells).at_range(point.range_m)
    encoder = getattr(settings, "radar_encoder", None)
    if point.pruning_ratio is None or not hasattr(encoder, "pruning_ratio"):
        return settings
    return replace(settings, radar_encoder=replace(encoder, pruning_ratio=point.pruning_ratio))


def fill_from_behind(case: Case, memory: Any, num_frames: int) -> None:
    """Make a memory of one frame a full one: the same frame seen from further and further behind."""
    (frame,) = memory.frames
    past = []
    for age in range(1, num_frames + 1):
        own = {"timestamps_s": frame.timestamps_s - KEY_FRAME_S * age}
        past.append(replace(copy.deepcopy(frame), global_from_ego=behind(frame, age + 1), **own))
    before = replace(case.batch, global_from_ego=behind(case.batch, 1))
    with torch.no_grad(), case.computing():
        # Once more by the model, which keeps of each frame what it reads at that age.
        _, case.memory = case.prepared(before, type(memory)(tuple(past)))
    case.batch = later(case.batch)


def behind(frame: Any, steps: int) -> Tensor:  # [B, 4, 4]
    """The pose of a frame so many steps before."""
    pose = frame.global_from_ego.clone()
    pose[:, 0, 3] -= EGO_STEP_M * steps
    return pose


def growth_rows(measured: dict[str, list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """How much time and memory grow over each sweep, over ranges from the nominal one; others beside the first."""
    rows = []
    for name, points in measured.items():
        row: dict[str, Any] = {"sweep": name}
        models = list(dict.fromkeys(point["model"] for point in points))
        for model in models:
            own = [point for point in points if point["model"] == model]
            first = next((point for point in own if point[name] == NOMINAL_M), own[0]) if "range" in name else own[0]
            row |= {"from": first[name], "to": own[-1][name]}
            row[f"{model} time x"] = own[-1]["ms"] / first["ms"]
            if first["added MiB"] is not None:
                row[f"{model} memory x"] = held_mib(own[-1]) / max(held_mib(first), 1e-9)
        for place in ("from", "to"):
            first, *others = (point for point in points if point[name] == row[place])  # as they were measured
            for other in others:
                ratio = f"{other['model']} / {first['model']} at {place}"
                row |= {ratio: other["ms"] / first["ms"], f"GFLOP {ratio}": other["GFLOP"] / first["GFLOP"]}
        rows.append(row)
    return rows
