"""suite=launches: what a frame and a training step would launch, wait for and upload on a GPU, counted without one."""

from __future__ import annotations

from collections import Counter
from typing import Any

import torch

from src.benchmark.cases import Case
from src.benchmark.launches import SMALL_IMAGE_PX, SMALL_ROAD, count, count_parts, on_simulated_device, small_case
from src.benchmark.parts import is_within, parts_of
from src.benchmark.scenes import made_batch
from src.benchmark.simulated_device import DEVICE, Tally, simulated_device
from src.benchmark.simulated_kernels import simulated_kernels
from src.config import Config
from src.errors import ConfigError
from src.models.deploy.whole_frames import WholeFrames
from src.ops.fixed_shapes import Capacities
from src.ops.precision import Precision, computing

SHOWN_PLACES = 12
FIXED = "a frame in fixed shapes"
ROOM = Capacities(points=1000, voxels=30000, cells=30000, pairs=150000)


def measure(config: Config, tree: dict[str, Any]) -> dict[str, Any]:
    """A table by part of a frame and of a step, and the places with most of each. Raises ConfigError for autocast."""
    if config.precision == Precision.MIXED:
        raise ConfigError(
            f"suite=launches counts on a simulated device, which has no autocast: precision={config.precision} cannot "
            f"run there; give precision={Precision.FULL}"
        )
    case = small_case(config)
    frame, frame_parts = count(case, case.prepared, case.infer)
    step, step_parts = count(case, case.model, case.step)
    fixed = count_in_fixed_shapes(case)
    return {
        "notes": [
            f"{config.model.name}, scale {config.scale}, {config.phase.name}, batch {len(case.batch)}, "
            f"{config.precision}, a full memory. Counted on a simulated device with Triton's kernels: the whole "
            f"architecture, images of {SMALL_IMAGE_PX[0]}x{SMALL_IMAGE_PX[1]}, {len(case.batch.radar_points)} radar "
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


def count_in_fixed_shapes(case: Case) -> tuple[Tally, dict[str, Counter[str]]] | None:
    """Counts of a frame in fixed shapes, from the host to its boxes there; None for a model without that form."""
    if case.prepared.fixed_form() is None:
        return None
    frame = made_batch(1, SMALL_ROAD, SMALL_IMAGE_PX)
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
