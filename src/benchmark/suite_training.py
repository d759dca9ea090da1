"""suite=training: frames per second of the configured phase's training step, with its loader and without."""

from __future__ import annotations

import math
import os
import statistics
import warnings
from collections.abc import Iterator
from typing import Any

import torch

from src.assembly import build_datamodule, build_module, data_root
from src.benchmark.operation_table import NOTE as OPERATIONS_NOTE
from src.benchmark.operation_table import operation_table
from src.benchmark.timing import chosen_device, clock, median_spread, peak_bytes, timed_parts
from src.config import Config
from src.data.datamodule import DetectionDataModule
from src.structures.batch import FrameBatch
from src.training.module import TrainingModule
from src.training.optim import CyclicSchedule, build_optimizer

WARM_UP_STEPS = 5  # first calls choose algorithms, fill the allocator and the loader's queue
MEASURED_STEPS = 40  # enough for quartiles of a step whose work follows the scene
PROFILED_STEPS = 2  # one to warm up


def benchmark_training(config: Config, tree: dict[str, Any]) -> dict[str, Any]:
    """Seconds of a step and its four stages, in two passes over the same batches with the same weights.

    `with loader` waits for the batches as training does; its workers share the machine. `loaded` finds them in memory.
    The steps are those of the run that this configuration would train, from fresh weights: forward, loss, checks and
    means of the training module, backward, clipping, AdamW and schedule. What the trainer adds (progress bar, logs,
    validation, checkpoints) is not in it. Steps per epoch and the schedule's length do not matter here.
    """
    device = chosen_device(config)
    datamodule = build_datamodule(config, data_root(config))
    batches: list[FrameBatch] = []
    passes = {}
    for name in ("with loader", "loaded"):
        torch.manual_seed(config.seed)
        module = build_module(config, tree, datamodule).to(device).train()
        source = endless_batches(datamodule) if name == "with loader" else iter(batches)
        passes[name], taken = run_steps(module, source, device, config.precision == "bf16-mixed")
        batches = taken
    rows = []
    for name, (stages, frames) in passes.items():
        step = [sum(values) for values in zip(*stages.values(), strict=True)]
        middle, spread = median_spread(step)
        rows.append(
            {
                "batches": name,
                "frames/s": sum(frames) / math.fsum(step),
                "frames/s (median step)": statistics.mean(frames) / middle,
                "step ms": 1e3 * middle,
                "± ms": 1e3 * spread,
            }
            | {f"{stage} ms": 1e3 * statistics.median(values) for stage, values in stages.items()}
        )
    optimizer, schedule = build_optimizer(
        module.model, module.optim, PROFILED_STEPS, module.model.image_backbone, module.backbone_lr_multiplier
    )
    last = batches[-1].to(device)
    operations = operation_table(
        lambda: timed_step(module, last, optimizer, schedule, device, config.precision == "bf16-mixed"), device
    )
    return {
        "notes": [
            f"{MEASURED_STEPS} steps of {config.data.batch_size} frames after {WARM_UP_STEPS}, {config.phase.name}, "
            f"scale {config.scale}, {config.precision}, {config.data.num_workers} loader workers, fresh weights. "
            "Medians, after ± the range of the middle half; frames/s counts the whole time.",
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


def endless_batches(datamodule: DetectionDataModule) -> Iterator[FrameBatch]:
    """Training batches, epoch after epoch."""
    loader = datamodule.train_dataloader()
    while True:
        yield from loader


def run_steps(
    module: TrainingModule, source: Iterator[FrameBatch], device: torch.device, autocast: bool
) -> tuple[tuple[dict[str, list[float]], list[int]], list[FrameBatch]]:
    """Seconds of each stage of the measured steps with the frames of each, and all batches that came."""
    now, model = clock(device), module.model
    optimizer, schedule = build_optimizer(
        model, module.optim, WARM_UP_STEPS + MEASURED_STEPS, model.image_backbone, module.backbone_lr_multiplier
    )
    stages: dict[str, list[float]] = {}
    frames, taken = [], []
    for number in range(WARM_UP_STEPS + MEASURED_STEPS):
        begin = now()
        batch = next(source)
        moved = batch.to(device, non_blocking=True)
        arrived = now()
        seconds = {"wait": arrived - begin} | timed_step(module, moved, optimizer, schedule, device, autocast)
        taken.append(batch)
        if number >= WARM_UP_STEPS:
            frames.append(len(batch))
            for name, value in seconds.items():
                stages.setdefault(name, []).append(value)
    return (stages, frames), taken


def timed_step(
    module: TrainingModule,
    batch: FrameBatch,
    optimizer: torch.optim.Optimizer,
    schedule: CyclicSchedule,
    device: torch.device,
    autocast: bool,
) -> dict[str, float]:
    """One optimiser step as the trainer makes it; seconds by stage."""
    now = clock(device)
    parts: dict[str, list[float]] = {}
    with warnings.catch_warnings(), timed_parts(module, {"run": ("run",), "loss": ("model.loss",)}, parts, device):
        warnings.filterwarnings("ignore", message=".*self.trainer.*")  # nothing is logged without a trainer
        begin = now()
        with torch.autocast(device.type, dtype=torch.bfloat16, enabled=autocast):
            objective = module.objective(batch)
        computed = now()
        optimizer.zero_grad(set_to_none=True)
        objective.terms["total"].backward()
        derived = now()
        module.clip_gradients_or_skip(batch, objective)
        optimizer.step()
        schedule.step()
        end = now()
    (forward,), (loss,) = parts["run"], parts["loss"]
    return {
        "forward": forward,
        "loss": loss,
        "backward": derived - computed,
        "optimiser": end - derived,
        "bookkeeping": computed - begin - forward - loss,  # the module's checks and means
    }
