"""suite=training: frames per second of the configured phase's training step, with its loader and without."""

from __future__ import annotations

import math
import os
import statistics
import warnings
from collections.abc import Callable, Iterator
from itertools import chain, repeat
from typing import Any

import torch

from src.assembly import build_datamodule, build_module, data_root
from src.benchmark.operation_table import OPERATIONS_NOTE, operation_table
from src.benchmark.timing import clock, milliseconds, peak_bytes, timed_parts
from src.config import Config
from src.ops.precision import computing
from src.structures.batch import FrameBatch
from src.training.module import TrainingModule
from src.training.optim import build_optimizer

WARM_UP_STEPS = 5  # first calls choose algorithms, fill the allocator and the loader's queue
MEASURED_STEPS = 40  # enough for quartiles of a step whose work follows the scene
PROFILED_STEPS = 2  # one to warm up


def measure(config: Config, tree: dict[str, Any]) -> dict[str, Any]:
    """Seconds of a step and its four stages, in two passes over the same batches with the same weights.

    `with loader` waits for the batches as training does; its workers share the machine. `loaded` finds them in memory.
    The steps are those of the run that this configuration would train, from fresh weights: forward, loss, checks and
    means of the training module, backward, clipping, AdamW and schedule. What the trainer adds (progress bar, logs,
    validation, checkpoints) is not in it. Steps per epoch and the schedule's length do not matter here.
    """
    device = config.trainer.device()
    datamodule = build_datamodule(config, data_root(config))
    batches: list[FrameBatch] = []
    passes = {}
    for name in ("with loader", "loaded"):
        torch.manual_seed(config.seed)
        module = build_module(config, tree, datamodule).to(device).train()
        loading = name == "with loader"
        source = chain.from_iterable(repeat(datamodule.train_dataloader())) if loading else iter(batches)
        passes[name], batches = run_steps(module, source, device, config.precision)
    rows = []
    for name, (stages, frames) in passes.items():
        step = [sum(values) for values in zip(*stages.values(), strict=True)]
        row = {"batches": name, "frames/s": sum(frames) / math.fsum(step)}
        row["frames/s (median step)"] = statistics.mean(frames) / statistics.median(step)
        row |= milliseconds(step, "step ")
        rows.append(row | {f"{stage} ms": 1e3 * statistics.median(values) for stage, values in stages.items()})
    last, step_on = batches[-1].to(device), make_stepper(module, PROFILED_STEPS, device, config.precision)
    operations = operation_table(lambda: step_on(last), device)
    return {
        "notes": [
            f"{MEASURED_STEPS} steps of {config.data.batch_size} frames after {WARM_UP_STEPS}, {config.phase.name}, "
            f"scale {config.scale}, {config.precision}, {config.data.num_workers} loader workers, fresh weights. "
            "Medians; ± is the interquartile range; frames/s counts the whole time.",
            OPERATIONS_NOTE,
        ],
        "training step": rows,
        "operations of a step": operations,
        "device": str(device),
        "batch_size": config.data.batch_size,
        "parameters": sum(p.numel() for p in module.model.parameters()),
        "peak_memory_mib": int(peak_bytes(device) / 2**20),
        "load_after": round(os.getloadavg()[0], 2),
    }


def run_steps(
    module: TrainingModule, source: Iterator[FrameBatch], device: torch.device, precision: str
) -> tuple[tuple[dict[str, list[float]], list[int]], list[FrameBatch]]:
    """Seconds of each stage of the measured steps with the frames of each, and all batches that came."""
    now, step_on = clock(device), make_stepper(module, WARM_UP_STEPS + MEASURED_STEPS, device, precision)
    stages: dict[str, list[float]] = {}
    frames, taken = [], []
    for number in range(WARM_UP_STEPS + MEASURED_STEPS):
        begin = now()
        batch = next(source)
        moved = batch.to(device, non_blocking=True)
        arrived = now()
        seconds = {"wait": arrived - begin} | step_on(moved)
        taken.append(batch)
        if number >= WARM_UP_STEPS:
            frames.append(len(batch))
            for name, value in seconds.items():
                stages.setdefault(name, []).append(value)
    return (stages, frames), taken


def make_stepper(
    module: TrainingModule, num_steps: int, device: torch.device, precision: str
) -> Callable[[FrameBatch], dict[str, float]]:
    """One optimiser step as the trainer makes it, with a fresh optimiser; seconds by stage."""
    optimizer, schedule = build_optimizer(
        module.model, module.optim, num_steps, module.model.image_backbone, module.backbone_lr_multiplier
    )
    now, paths = clock(device), {"forward": ("run",), "loss": ("model.loss",)}

    def step(batch: FrameBatch) -> dict[str, float]:
        with warnings.catch_warnings(), timed_parts(module, paths, now) as parts:
            warnings.filterwarnings("ignore", message=".*self.trainer.*")  # nothing is logged without a trainer
            begin = now()
            with computing(precision, device):
                objective = module.objective(batch)
            computed = now()
            optimizer.zero_grad(set_to_none=True)
            objective.terms["total"].backward()
            went_back = now()
            module.clip_gradients_or_skip(batch, objective)
            optimizer.step()
            schedule.step()
            end = now()
        rest = computed - begin - sum(parts.values())  # the module's checks and means
        return {**parts, "backward": went_back - computed, "optimiser": end - went_back, "bookkeeping": rest}

    return step
