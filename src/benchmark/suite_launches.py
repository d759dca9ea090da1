"""suite=launches: what a frame and a training step would launch, wait for and upload on a GPU, counted without one."""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch

from src.benchmark.cases import KEY_FRAME_S, Case, build_case, expect_trained_scores
from src.benchmark.parts import is_within, parts_of, wrapped_parts
from src.benchmark.scenes import Highway, highway_frame, highway_points
from src.benchmark.simulated_device import DEVICE, SimulatedDevice, Tally
from src.benchmark.simulated_kernels import simulated_kernels
from src.config import Config
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from src.structures.taxonomy import CLASSES

ROAD = Highway(background=600, num_vehicles=12, points_per_vehicle=10, reach_m=150.0)
"""Few points: what is counted follows the code and hardly the values."""
IMAGE_SIZE_PX = (64, 128)
NUM_BOXES = 24
SHOWN_PLACES = 12


def measure(config: Config, tree: dict[str, Any]) -> dict[str, Any]:
    """A table by part of a frame and of a step, and the places with most of each."""
    case = make_case(config)
    frame, frame_parts = count(case, case.prepared, case.infer)
    step, step_parts = count(case, case.model, case.step)
    return {
        "notes": [
            f"{config.model.name}, scale {config.scale}, {config.phase.name}, batch {len(case.batch)}, "
            f"{config.precision}, a full memory. Counted on a simulated device with Triton's kernels: the whole "
            f"architecture, images of {IMAGE_SIZE_PX[0]}x{IMAGE_SIZE_PX[1]}, {len(case.batch.radar_points)} radar "
            "points. The frame lies on the device already.",
            "Launches are operations that run on the device, factories included; a sort counts as one. Waits are the "
            "times that the host stands still for a value, a size or a blocking copy; dispatches all calls of torch, "
            "views included. A part within another is counted in both; the backward pass stands in its own row.",
        ],
        "a frame": part_rows(frame, frame_parts),
        "a training step": part_rows(step, step_parts),
        "places with most launches": place_rows(frame, step, "launches"),
        "places with waits": place_rows(frame, step, "waits"),
        "places with uploads": place_rows(frame, step, "uploads"),
    }


def make_case(config: Config) -> Case:
    """The configured model on a made frame, its memory full, on the simulated device once that is entered."""
    torch.manual_seed(config.seed)
    device = torch.device("cpu")
    if config.backbone is not None:  # the counts do not follow the size of an image
        config = replace(config, backbone=replace(config.backbone, image_size_px=list(IMAGE_SIZE_PX)))
    case = build_case(config, made_batch(config.data.batch_size), device)
    with torch.no_grad():
        for _ in range(config.model.memory_frames):
            _, case.memory = case.prepared(case.batch, case.memory)
            case.batch = later(case.batch)
    expect_trained_scores(case)
    return case


def later(batch: FrameBatch) -> FrameBatch:
    """The next key frame of a truck that stands."""
    return replace(batch, timestamps_s=batch.timestamps_s + KEY_FRAME_S)


def made_batch(batch_size: int) -> FrameBatch:
    """Frames of a made highway with boxes, each sample another draw."""
    frames = [highway_frame(highway_points(ROAD, seed), IMAGE_SIZE_PX) for seed in range(batch_size)]
    owners = [torch.full((len(frame.radar_points),), row) for row, frame in enumerate(frames)]
    joined = {
        name: torch.cat([getattr(frame, name) for frame in frames])
        for name in (
            "timestamps_s", "global_from_ego", "aug_from_ego", "radar_points", "images", "image_valid", "pix_from_aug",
        )
    }  # fmt: skip
    joined |= {"radar_batch": torch.cat(owners), "boxes": [made_boxes(seed) for seed in range(batch_size)]}
    return FrameBatch([f"synthetic {row}" for row in range(batch_size)], **joined)


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
    parts = parts_of(case.model)
    found: dict[str, Counter[str]] = {}
    with SimulatedDevice() as tally, simulated_kernels():
        held = (case.model, case.prepared, case.batch, case.memory, case.device)
        moved = on_simulated_device(model)
        case.model = case.prepared = moved
        case.batch, case.memory = case.batch.to(DEVICE), case.memory and case.memory.to(DEVICE)
        case.device = torch.device(DEVICE)
        run()  # fills the caches of constants
        tally.__init__()

        def counted(name: str, path: str, function: Callable[..., Any]) -> Callable[..., Any]:
            def call(*arguments: Any, **named: Any) -> Any:
                before = tally.totals()
                result = function(*arguments, **named)
                found.setdefault(name, Counter()).update(Counter(tally.totals()) - Counter(before))
                return result

            return call

        with wrapped_parts(moved, parts, counted):
            run()
        case.model, case.prepared, case.batch, case.memory, case.device = held
    return tally, found


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
