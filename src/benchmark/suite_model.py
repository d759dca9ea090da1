"""suite=model: time, arithmetic, memory traffic and memory of a model's parts, each against its roofline bound."""

from __future__ import annotations

import logging
import statistics
from collections.abc import Callable
from typing import Any

import torch

from src.assembly import build_datamodule, data_root
from src.benchmark.cases import CANDIDATES, Case, build_case, expect_trained_scores, fill_memory
from src.benchmark.counting import counted_work, distinct_bytes
from src.benchmark.machine import gemm_rate, measure_roofline
from src.benchmark.operation_table import OPERATIONS_NOTE, operation_table
from src.benchmark.page import gpu_notes
from src.benchmark.parts import Call, backward_from, parts_of, record_calls, tensors_in
from src.benchmark.scenes import ROADS, lidar_frame
from src.benchmark.timing import (
    added_mib,
    clock,
    interleaved,
    milliseconds,
    peak_bytes,
    seconds_of,
)
from src.config import Config
from src.training.phases import EVALUATORS

logger = logging.getLogger(__name__)

ROUNDS = 5  # of all parts; a round of the full size takes ten seconds on two cores
BACKWARD_PASSES = 3  # of inputs, outputs and weights: forward, and once more each for gradients to be read and written
POINTS = ("radar_points", "lidar_points")  # of a batch, None without the sensor
WHOLE = "whole: frame to boxes, step to gradients"
WHOLE_WITHOUT_BOXES = "whole: frame to answers, step to gradients"


def measure(config: Config, tree: dict[str, Any]) -> dict[str, Any]:
    """The configured model on the first training batch; see `measure_parts` for the columns."""
    torch.manual_seed(config.seed)
    device = config.trainer.device()
    case = first_case(config, device)
    roofline = measure_roofline(device)
    rate = gemm_rate(roofline, config.precision)
    tables = measure_parts(case, rate, roofline["copy_gbps"])
    loss = case.step()
    with torch.no_grad():
        state = case.model.diagnostics(case.run()[0])
    return {
        "notes": [
            f"{config.model.name}, scale {config.scale}, {config.phase.name}, batch {len(case.batch)}, "
            f"{config.precision} on {device}. Medians of {ROUNDS} rounds in which every part is called in turn, alone, "
            "on the inputs that it has within the model; ± is the interquartile range. Forward is the model as "
            "prediction prepares it, f+b forward and backward of the model as it is trained. " + asked_of(config, case),
            "GFLOP are those of matrix products, convolutions and attention. The roofline bound is the longer of GFLOP "
            "over the measured GEMM rate and bytes over the measured copy rate, bytes being inputs, outputs and "
            f"weights once ({BACKWARD_PASSES} times with backward). Traffic is what all operations read and write "
            "without fusion and cache. Added memory is the most that a call takes beyond its inputs and weights.",
            OPERATIONS_NOTE,
            *gpu_notes(device),
        ],
        **tables,
        "operations of a frame": operation_table(case.infer, device),
        "operations of forward, loss and backward": operation_table(case.step, device),
        "roofline": roofline,
        "device": str(device),
        "batch_size": len(case.batch),
        "peak_memory_mib": int(peak_bytes(device) / 2**20),
        "parameters": {n: sum(p.numel() for p in part.parameters()) for n, part in case.model.named_children()},
        **{name: len(points) for name in POINTS if (points := getattr(case.batch, name)) is not None},
        "loss": float(loss),
        "state": {name: float(value) for name, value in state.items()},
    }


def asked_of(config: Config, case: Case) -> str:
    """What fresh weights are, and what the model is asked."""
    if case.learns_boxes:
        return "" if config.checkpoint else f"Fresh weights; {CANDIDATES} cells pass the score threshold."
    fresh = "" if config.checkpoint else "Fresh weights. "
    return f"{fresh}A made frame; forward also answers where its {len(case.batch.rays)} rays end."


def first_case(config: Config, device: torch.device) -> Case:
    """The configured model on its first training batch, or, where it learns from rays alone, on a made frame that needs
    no world; one with a memory sees the truck stand until it is full."""
    if EVALUATORS[config.phase.task].labels:
        config.data.num_workers = 0
        datamodule = build_datamodule(config, data_root(config))
        batch = next(iter(datamodule.train_dataloader()))
    else:
        batch = lidar_frame(ROADS[config.scale])
    case = build_case(config, batch.to(device), device)
    fill_memory(case, config.model.memory_frames)
    if not config.checkpoint:
        expect_trained_scores(case)
    return case


def measure_parts(
    case: Case,
    rate: float,  # GFLOP/s
    bandwidth: float,  # GB/s
) -> dict[str, list[dict[str, Any]]]:
    """Two tables with a row for each part, and for all of them: `time by part` and `work by part`."""
    parts = parts_of(case.model)
    inferred = record_calls(case.prepared, parts, case.infer)
    forward = measure_mode(case, inferred, backward=False)
    # What only the loss asks for, as answers at places, is part of a step without boxes.
    learn = case.run if case.learns_boxes else case.losses
    trained = record_calls(case.model, {name: parts[name] for name in inferred}, learn)
    both = measure_mode(case, trained, backward=True)
    modes = {"forward": forward, "f+b": both}
    times, works = [], []
    for name in forward:
        time_row, work_row = {"part": name}, {"part": name}
        for mode, found in modes.items():
            if name in found:
                time_row |= time_columns(mode, found[name], rate, bandwidth)
                work_row |= work_columns(mode, found[name])
        times.append(time_row)
        works.append(work_row)
    whole = WHOLE if case.learns_boxes else WHOLE_WITHOUT_BOXES
    time_row, work_row = {"part": whole}, {"part": whole}
    for mode, function in (("forward", case.infer), ("f+b", case.step)):
        work_row |= work_columns(mode, measure_work(function, case.device)[0])
        time_row |= milliseconds(interleaved({mode: function}, clock(case.device), ROUNDS)[mode], f"{mode} ")
    return {"time by part": [*times, time_row], "work by part": [*works, work_row]}


def time_columns(mode: str, found: dict[str, Any], rate: float, bandwidth: float) -> dict[str, Any]:
    """How long a part takes, and its roofline bound."""
    by_rate, by_bandwidth = found["flops"] / rate / 1e9, found["compulsory_bytes"] / bandwidth / 1e9
    bound_s = max(by_rate, by_bandwidth)
    return {
        f"{mode} % of roofline": 100 * bound_s / statistics.median(found["seconds"]),
        **milliseconds(found["seconds"], f"{mode} "),
        f"{mode} roofline ms": 1e3 * bound_s,
        f"{mode} bound by": "compute" if by_rate >= by_bandwidth else "memory",
    }


def work_columns(mode: str, found: dict[str, Any]) -> dict[str, Any]:
    """What a part computes, moves and holds."""
    compulsory = found.get("compulsory_bytes")
    return {
        f"{mode} GFLOP": found["flops"] / 1e9,
        f"{mode} MB": None if compulsory is None else compulsory / 1e6,
        f"{mode} traffic MB": found["traffic_bytes"] / 1e6,
        f"{mode} added MiB": found["added_mib"],
    }


def measure_mode(case: Case, calls: dict[str, list[Call]], backward: bool) -> dict[str, dict[str, Any]]:
    """Seconds, arithmetic and bytes of every part; a part whose results have no history counts as its forward."""

    def prepared(name: str) -> Callable[[], bool]:
        ready = [call.prepare() for call in calls[name]]

        def run() -> bool:
            with torch.set_grad_enabled(backward), case.computing():
                results = [call() for call in ready]
            return backward and any([backward_from(result) for result in results])

        return run

    found: dict[str, dict[str, Any]] = {}
    for name in calls:
        found[name], went_back = measure_work(lambda name=name: prepared(name)(), case.device)
        passes = BACKWARD_PASSES if went_back else 1
        found[name] |= {"compulsory_bytes": passes * compulsory_bytes(calls[name]), "seconds": []}
        case.model.zero_grad(set_to_none=True)
    for number in range(1 + ROUNDS):
        logger.info("%s, round %d of %d", "f+b" if backward else "forward", number, ROUNDS)
        for name in calls:
            seconds = seconds_of(prepared(name), clock(case.device))
            case.model.zero_grad(set_to_none=True)
            found[name]["seconds"] += [seconds] if number else []
    return found


def measure_work(function: Callable[[], Any], device: torch.device) -> tuple[dict[str, Any], Any]:
    """Arithmetic, traffic and added memory of a call, and its result."""
    with counted_work() as work:
        result = function()
    return {"flops": work.flops, "traffic_bytes": work.bytes, "added_mib": added_mib(function, device)}, result


def compulsory_bytes(calls: list[Call]) -> int:
    """Inputs, results and weights of a part, each once: what no implementation can avoid to read or to write."""
    owners = [getattr(call.function, "__self__", None) for call in calls]
    weights = [p for owner in owners if isinstance(owner, torch.nn.Module) for p in owner.parameters()]
    values = tensors_in([[call.arguments, call.named, call.result] for call in calls])
    return distinct_bytes([*weights, *values])
