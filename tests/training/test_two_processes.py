"""Two processes train and score as one with the same batch does (CPU, gloo)."""

import importlib.util
import os
import signal
import time
from dataclasses import dataclass, replace
from pathlib import Path

import lightning as L
import numpy as np
import pytest
import torch
import torch.multiprocessing as mp
from torch.utils.data import DataLoader

from src.data.datamodule import collate, in_lane
from src.metrics.detection import score_detections
from src.structures.detections import DetectionTable, EvaluationSet
from src.training.optim import OptimConfig
from src.training.processes import SharedBuffers, build_strategy, process_group
from src.training.temporal import TemporalModule

LANES, STEPS = 4, 3
FIRST_RANK, SECOND_RANK = (0, 1), (2, 3)
DEADLINE_S = 120.0


def _of_the_models_tests():
    """The small model and its frames are described beside the model's own tests."""
    path = Path(__file__).parents[1] / "models" / "horizon3d" / "conftest.py"
    spec = importlib.util.spec_from_file_location("horizon3d_conftest", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


parts = _of_the_models_tests()
grid, backbone, make_batch = parts.grid, parts.backbone, parts.make_batch
make_config, make_model = parts.make_config, parts.make_model


@dataclass
class Work:
    """What one process does, as values that travel to it."""

    model: torch.nn.Module
    train: list[list]  # per step and lane, a batch of one
    validation: list[list]  # of each of two processes, batches
    truth: EvaluationSet
    folder: Path
    eval_norms: bool = True


class Module(TemporalModule):
    """Plain gradient descent, so that a parameter's change is its gradient, and norms and dropout held still."""

    eval_norms = True
    totals = ()

    def on_train_batch_start(self, batch, batch_idx):
        super().on_train_batch_start(batch, batch_idx)
        if self.eval_norms:
            self.model.eval()

    def training_step(self, batch, batch_idx):
        total = super().training_step(batch, batch_idx)
        self.totals = [*self.totals, float(total.detach())]
        return total

    def configure_optimizers(self):
        return torch.optim.SGD(self.model.parameters(), lr=1e-3)


def work_as(rank, world_size, port, work):
    """Train three steps and validate, as rank `rank` of `world_size`; the result goes to a file."""
    torch.set_num_threads(1)
    if world_size > 1:
        who = {"LOCAL_RANK": rank, "RANK": rank, "WORLD_SIZE": world_size, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
        os.environ.update({name: str(value) for name, value in who.items()})
    optim = OptimConfig(
        lr=1e-3, weight_decay=0.0, clip_norm=35.0, peak_lr_ratio=1.0, final_lr_ratio=1.0, rise_fraction=0.5,
        betas=[0.9, 0.99], cycled_beta1=None, ema_decay=None,
    )  # fmt: skip
    module = Module(work.model, optim, 1.0, work.truth, 0, {})
    module.eval_norms = work.eval_norms
    lanes = (FIRST_RANK, SECOND_RANK)[rank] if world_size > 1 else range(LANES)
    train = [collate([frames[lane] for lane in lanes]) for frames in work.train]
    validation = work.validation[rank] if world_size > 1 else [batch for part in work.validation for batch in part]
    with process_group("cpu", world_size):
        trainer = L.Trainer(
            max_epochs=1, accelerator="cpu", devices=world_size, strategy=build_strategy("cpu", world_size),
            callbacks=[SharedBuffers()], logger=False, enable_checkpointing=False, enable_progress_bar=False,
            enable_model_summary=False, num_sanity_val_steps=0, use_distributed_sampler=False,
        )  # fmt: skip
        loaders = [DataLoader(batches, batch_size=None, num_workers=0) for batches in (train, validation)]
        trainer.fit(module, *loaders)
    result = {
        "totals": module.totals,
        "state": module.model.state_dict(),
        "detections": {name: getattr(module.detections, name) for name in DetectionTable.__dataclass_fields__},
        "scores": module.scores.as_dict(),
    }
    torch.save(result, work.folder / f"{world_size}-{rank}.pt")


def in_two_processes(port, work):
    """Both ranks with a deadline; their results."""
    context = mp.spawn(work_as, (2, port, work), nprocs=2, join=False)
    deadline = time.monotonic() + DEADLINE_S
    try:
        while not context.join(timeout=1.0):
            assert time.monotonic() < deadline, "the two processes hang"
    finally:
        for process in context.processes:
            if process.is_alive():
                os.kill(process.pid, signal.SIGKILL)
    return [torch.load(work.folder / f"2-{rank}.pt", weights_only=False) for rank in range(2)]


def in_one_process(work):
    work_as(0, 1, 0, replace(work, model=_copy(work.model)))
    return torch.load(work.folder / "1-0.pt", weights_only=False)


def _copy(model):
    import copy

    return copy.deepcopy(model)
