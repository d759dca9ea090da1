"""suite=launches: what a frame and a training step would launch, wait for and upload on a GPU, counted without one."""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch

from src.benchmark.cases import Case, build_case, expect_trained_scores, fill_memory
from src.benchmark.parts import is_within, parts_of, wrapped_parts
from src.benchmark.scenes import Highway, highway_frame, highway_points
from src.benchmark.simulated_device import DEVICE, Tally, simulated_device
from src.benchmark.simulated_kernels import simulated_kernels
from src.config import Config
from src.data.frame_loader import collate
from src.errors import ConfigError
from src.models.deploy.whole_frames import WholeFrames
from src.ops.fixed_shapes import Capacities
from src.ops.precision import Precision, computing
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from src.structures.taxonomy import CLASSES

ROAD = Highway(background=600, num_vehicles=12, points_per_vehicle=10, reach_m=150.0)
IMAGE_SIZE_PX = (64, 128)
"""Few points and pixels: what is counted follows the code and hardly the values."""
NUM_BOXES = 24
SHOWN_PLACES = 12
FIXED = "a frame in fixed shapes"
ROOM = Capacities(points=1000, voxels=30000, cells=30000, pairs=150000)
CPU = torch.device("cpu")


def measure(config: Config, tree: dict[str, Any]) -> dict[str, Any]:
    """A table by part of a frame and of a step, and the places with most of each. Raises ConfigError for autocast."""
    if config.precision == Precision.MIXED:
        raise ConfigError(
            f"suite=launches counts on a simulated device, which has no autocast: precision={config.precision} cannot "
            f"run there; give precision={Precision.FULL}"
        )
    case = make_case(config)
    frame, frame_parts = count(case, case.prepared, case.infer)
    step, step_parts = count(case, case.model, case.step)
    fixed = count_in_fixed_shapes(case)
    return {
        "notes": [
            f"{config.model.name}, scale {config.scale}, {config.phase.name}, batch {len(case.batch)}, "
            f"{config.precision}, a full memory. Counted on a simulated device with Triton's kernels: the whole "
            f"architecture, images of {IMAGE_SIZE_PX[0]}x{IMAGE_SIZE_PX[1]}, {len(case.batch.radar_points)} radar "
            "points. The frame lies on the device already.",
            "Launches are operations that run on the device, factories included; a sort counts as one. Waits are the "
            "times that the host stands still for a value, a size or a blocking copy; dispatches all calls of torch, "
            "views included. A part within another is counted in both; the backward pass stands in its own row.",
            "In fixed shapes a frame comes from the host in one upload, and its boxes return in one copy, the wait; "
            f"memory and decoding stand in the rest. Counted with {ROOM}; the count does not depend on them.",
        ],
        "a frame": part_rows(frame, frame_parts),
        **({} if fixed is None else {FIXED: part_rows(*fixed)}),
        "a training step": part_rows(step, step_parts),
        "places with most launches": place_rows(frame, step, "launches"),
        "places with waits": place_rows(frame, step, "waits"),
        "places with uploads": place_rows(frame, step, "uploads"),
    }


def make_case(
    config: Config,
    device: torch.device = CPU,
    road: Highway = ROAD,
    image_size_px: tuple[int, int] = IMAGE_SIZE_PX,
) -> Case:
    """The configured model on a made frame, its memory full."""
    torch.manual_seed(config.seed)
    config = replace(config, backbone=replace(config.backbone, image_size_px=list(image_size_px)))
    batch = made_batch(config.data.batch_size, road, image_size_px).to(device)
    case = build_case(config, batch, device)
    fill_memory(case, config.model.memory_frames)
    expect_trained_scores(case)
    return case


def made_batch(batch_size: int, road: Highway, image_size_px: tuple[int, int], seed: int = 0) -> FrameBatch:
    """Frames of a made highway with boxes, each sample another draw."""
    draws = range(seed, seed + batch_size)
    frames = [highway_frame(highway_points(road, draw), image_size_px) for draw in draws]
    return collate([replace(frame, boxes=[made_boxes(draw)]) for frame, draw in zip(frames, draws, strict=True)])


def made_boxes(seed: int) -> Boxes3D:
    """Boxes of every class along the road, one without a known velocity."""
    draw = torch.Generator().manual_seed(seed)
    number = torch.arange(NUM_BOXES)
    centers = torch.stack([-100.0 + 8.0 * number, 4.0 * (number % 3) - 4.0, torch.ones(NUM_BOXES)], 1)
    velocities = 10.0 * torch.rand(NUM_BOXES, 2, generator=draw)
    velocities[0] = torch.nan
    return Boxes3D(
        centers=centers,
        sizes=torch.tensor([4.5, 1.9, 1.6]).repeat(NUM_BOXES, 1),
        yaws=torch.rand(NUM_BOXES, generator=draw),
        velocities=velocities,
        labels=number % len(CLASSES),
        attributes=torch.full((NUM_BOXES,), -1),
        num_points=torch.full((NUM_BOXES,), 5),
    )


def count(case: Case, model: torch.nn.Module, run: Callable[[], Any]) -> tuple[Tally, dict[str, Counter[str]]]:
    """The tally of a run on the simulated device, and that of each part; the case is on the CPU again afterwards."""
    with simulated_device() as tally, simulated_kernels():
        held = (case.model, case.prepared, case.batch, case.memory, case.device)
        moved = on_simulated_device(model)
        case.model = case.prepared = moved
        case.batch, case.memory = case.batch.to(DEVICE), case.memory and case.memory.to(DEVICE)
        case.device = torch.device(DEVICE)
        parts = count_parts(tally, moved, parts_of(held[0]), run)
        case.model, case.prepared, case.batch, case.memory, case.device = held
    return tally, parts


def count_in_fixed_shapes(case: Case) -> tuple[Tally, dict[str, Counter[str]]] | None:
    """The same of a frame that lies on the host, to its boxes there; None for a model that has no such form."""
    if case.prepared.fixed_form() is None:
        return None
    frame = made_batch(1, ROAD, tuple(case.batch.images.shape[-2:]) if case.batch.images is not None else IMAGE_SIZE_PX)
    with (
        simulated_device() as tally,
        simulated_kernels(),
        torch.no_grad(),
        computing(case.precision, torch.device(DEVICE)),
    ):
        moved = on_simulated_device(case.prepared)
        whole = WholeFrames(moved.fixed_form(ROOM), torch.device(DEVICE), captured=False)
        parts = count_parts(tally, moved, parts_of(case.model), lambda: whole.step(frame))
    return tally, parts


def count_parts(
    tally: Tally, model: torch.nn.Module, parts: dict[str, tuple[str, ...]], run: Callable[[], Any]
) -> dict[str, Counter[str]]:
    """The tally of each part of a run, which that of all is afterwards."""
    found: dict[str, Counter[str]] = {}

    def counted(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            before = tally.totals()
            result = function(*arguments, **named)
            found.setdefault(name, Counter()).update(Counter(tally.totals()) - Counter(before))
            return result

        return call

    run()  # fills the caches of constants
    tally.__init__()
    with wrapped_parts(model, parts, counted):
        run()
    return found


def on_simulated_device(model: torch.nn.Module) -> torch.nn.Module:
    """A copy of the model there."""
    return copy.deepcopy(model).to(DEVICE)


def part_rows(tally: Tally, parts: dict[str, Counter[str]]) -> list[dict[str, Any]]:
    """A row for each part, for what lies between and behind them, and for all."""
    total = tally.totals()
    outer = sum((values for name, values in parts.items() if not is_within(name)), Counter())
    rows = [{"part": name, **{key: values[key] for key in total}} for name, values in parts.items()]
    rows.append({"part": "rest (losses, backward)", **{key: total[key] - outer[key] for key in total}})
    return [*rows, {"part": "whole", **total}]


def place_rows(frame: Tally, step: Tally, kind: str) -> list[dict[str, Any]]:
    """The lines of src with most of a kind in frame and step."""
    by_place: dict[str, Counter[str]] = {}
    for column, tally in (("frame", frame), ("step", step)):
        for (_, place), number in getattr(tally, kind).items():
            by_place.setdefault(place, Counter())[column] += number
    ranked = sorted(by_place.items(), key=lambda item: -item[1].total())[:SHOWN_PLACES]
    return [{"place": place, "frame": counts["frame"], "step": counts["step"]} for place, counts in ranked]
