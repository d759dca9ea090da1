"""What a run of a model would launch, wait for and upload on a GPU, part by part, counted on a simulated device."""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Callable
from typing import Any

import torch

from src.benchmark.cases import Case, made_case
from src.benchmark.parts import parts_of, wrapped_parts
from src.benchmark.scenes import Highway
from src.benchmark.simulated_device import DEVICE, Tally, simulated_device
from src.benchmark.simulated_kernels import simulated_kernels
from src.config import Config

SMALL_ROAD = Highway(background=600, num_vehicles=12, points_per_vehicle=10, reach_m=150.0)
SMALL_IMAGE_PX = (64, 128)
"""Few points and pixels: what is counted follows the code and hardly the values."""


def small_case(config: Config) -> Case:
    """The configured model on the CPU, on a frame that is quickly counted."""
    return made_case(config, torch.device("cpu"), SMALL_ROAD, SMALL_IMAGE_PX)


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


def count_parts(
    tally: Tally, model: torch.nn.Module, parts: dict[str, tuple[str, ...]], run: Callable[[], Any]
) -> dict[str, Counter[str]]:
    """Count each part of a run; `tally` afterwards holds the count of the whole run."""
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
    """A copy of the model on the simulated device."""
    return copy.deepcopy(model).to(DEVICE)
