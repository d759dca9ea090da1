"""What a finished run says of itself: the table people wait for, how it was computed, where everything lies."""

from __future__ import annotations

import logging
import platform
import resource
from typing import Any

import lightning as L
import numpy as np
import torch

from src.errors import DataError
from src.ops.precision import Precision
from src.ops.products import describe_products
from src.reliability.cpu import peak_resident_bytes
from src.structures.skipped import SHOWN_NAMES
from src.training.module import TrainingModule
from src.training.phases import EVALUATORS
from src.training.run_config import RunConfig
from src.training.run_folder import RunFolder, current_commit

logger = logging.getLogger(__name__)

FILES = ("metrics.json", "metrics.csv", "config.yaml", "log.txt", "pictures", "submission.json")
"""What a user may look at of a finished run."""


def run_record(
    config: RunConfig,
    module: TrainingModule,  # trained, still with its trainer
    **known: Any,  # by its name in run.json
) -> dict[str, Any]:
    """Content of run.json: what was asked for, what ran, and on what."""
    return known | {
        "task": config.phase.task,
        "headline": module.evaluator.headline,
        "scale": config.scale,
        "seed": config.seed,
        "commit": current_commit(),
        "epochs": config.phase.epochs,
        "steps": module.trainer.global_step,
        "parameters": sum(p.numel() for p in module.model.parameters()),
        "skipped_steps": module.guard.skipped_steps,
        "peak_memory_mib": peak_memory_mib(),
        "device": str(module.device),
        "processes": config.trainer.num_processes,
        "threads": torch.get_num_threads(),
        "cpu_products": describe_products(config.precision == Precision.PRODUCTS),
        "versions": {
            "python": platform.python_version(),
            "torch": torch.__version__,
            "lightning": L.__version__,
            "numpy": np.__version__,
        },
    }


def peak_memory_mib() -> dict[str, int]:
    """Largest resident memory of this process and of its largest ended child (a loader worker)."""
    return {
        name: peak_resident_bytes(who) // 2**20
        for name, who in (("process", resource.RUSAGE_SELF), ("largest_worker", resource.RUSAGE_CHILDREN))
    }


def show_finished(folder: RunFolder) -> None:
    """Print a finished run, and say when other code than today's made it. Raises DataError for edited results."""
    record, scores = folder.read_result()
    try:
        if record["commit"] != current_commit():
            logger.warning(
                "this run was made by commit %s, the code is at %s; resume=restart trains it anew",
                record["commit"],
                current_commit(),
            )
        print_result(folder, record, scores)
    except (KeyError, TypeError, ValueError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise DataError(
            f"{folder.record} or metrics.json beside it is not as written ({reason}); delete it to have it made again"
        ) from error


def print_result(folder: RunFolder, record: dict[str, Any], scores: dict[str, Any]) -> None:
    """The scores, what the run took, and where everything lies."""
    print(EVALUATORS[record["task"]].describe(scores))
    print(
        f"\n{folder.run_id}: {record['epochs']} epochs, {record['steps']} steps, {record['parameters'] / 1e6:.2f} M "
        f"parameters, {record['seconds']['all']:.0f} s, {record['peak_memory_mib']['process']} MiB"
    )
    if record["skipped_files"]:
        names = record["skipped_names"]
        shown = f": {', '.join(names[:SHOWN_NAMES])}{' ...' if len(names) > SHOWN_NAMES else ''}" if names else ""
        print(f"skipped sensor files: {record['skipped_files']}{shown} (names in run.json)")
    written = [name for name in FILES if (folder.path / name).exists()]
    print(f"run folder: {folder.path}  ({', '.join(written)})")
