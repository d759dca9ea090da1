"""A detector of a few parameters with a memory of one number per stream, and frames to stream to it."""

from dataclasses import dataclass

import lightning as L
import torch
from torch import nn
from torch.utils.data import DataLoader, Sampler

from src.models.detector import Detector, Objective
from src.reliability.processes import is_main_process
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from src.structures.detections import DetectionTable
from src.training.evaluator import DetectionEvaluator
from src.training.fit import build_loggers, build_trainer, fit
from src.training.optim import OptimConfig
from src.training.phases import PhaseConfig
from src.training.run_folder import Resume
from src.training.temporal_module import TemporalModule
from src.training.trainer_config import Accelerator, OnNonfinite, TrainerConfig
from tests.evaluation_sets import set_of

STEPS = 3  # of one epoch
EPOCHS = 3


@dataclass(frozen=True)
class ToyMemory:
    """One number per stream."""

    values: torch.Tensor  # [B]

    @property
    def present(self):
        return self.values[None] != 0

    def select(self, rows, keep):
        return ToyMemory(torch.where(keep, self.values[rows], 0.0))

    def to(self, device):
        return ToyMemory(self.values.to(device))

    def state(self):
        return [{"values": self.values, "nothing": None}]


class ToyDetector(Detector):
    """Mean of the points through a linear layer and dropout, plus what the stream remembers of it."""

    def __init__(self):
        super().__init__()
        self.layer, self.dropout = nn.Linear(7, 1), nn.Dropout(0.3)

    def forward(self, batch, memory=None):
        points = torch.stack([batch.radar_points[batch.radar_batch == row].mean(0) for row in range(len(batch))])
        past = torch.zeros(len(batch)) if memory is None else memory.values
        output = self.layer(self.dropout(points)).squeeze(1) + past
        return output, ToyMemory(output.detach())

    def restore_memory(self, state):
        return ToyMemory(state[0]["values"])

    def loss_terms(self, output, batch):
        return Objective({"near": (output - 1.0).square().mean(), "small": output.abs().mean()}, {})

    def diagnostics(self, output):
        return {"spread": output.detach().std()}

    def decode(self, output):
        return [Boxes3D.empty() for _ in output]


def toy_batch(streams, starts, number=0):
    """Random frames of some streams; None for frames without streams."""
    size = len(streams) if streams is not None else 2
    generator = torch.Generator().manual_seed(number)
    return FrameBatch(
        tokens=[f"frame {number} {row}" for row in range(size)],
        timestamps_s=torch.full((size,), float(number), dtype=torch.float64),
        global_from_ego=torch.eye(4, dtype=torch.float64).repeat(size, 1, 1),
        aug_from_ego=torch.eye(4).repeat(size, 1, 1),
        radar_points=torch.randn(3 * size, 7, generator=generator),
        radar_batch=torch.arange(size).repeat_interleave(3),
        streams=None if streams is None else torch.tensor(streams),
        starts=None if streams is None else torch.tensor(starts),
    )


def toy_evaluation_set():
    tokens = [f"frame {number} {row}" for number in range(100, 103) for row in range(2)]
    return set_of(DetectionTable.empty(), tokens)


class Positions(Sampler):
    """Steps of the epoch that are left, by the trainer's count."""

    def __init__(self, trainer, read):
        self.trainer, self.read = trainer, read

    def __len__(self):
        return STEPS

    def __iter__(self):
        epoch, done = divmod(self.trainer.global_step, STEPS)
        for step in range(done, STEPS):
            self.read.append((epoch, step))
            yield epoch, step


class Frames:
    """Batches by (epoch, step); the second stream begins a new clip at step 2."""

    def __init__(self, rank):
        self.rank = rank

    def __getitem__(self, key):
        epoch, step = key
        streams, starts = [2 * self.rank, 2 * self.rank + 1], [step == 0, step in (0, 2)]
        return toy_batch(streams, starts, number=1000 * self.rank + 10 * epoch + step)


class ToyData(L.LightningDataModule):
    """Clips in two streams of each rank for training; three batches for validation, the last on every rank."""

    def __init__(self):
        super().__init__()
        self.read = []  # (epoch, step) in the order of reading

    def train_dataloader(self):
        return DataLoader(Frames(self.trainer.global_rank), batch_size=None, sampler=Positions(self.trainer, self.read))

    def val_dataloader(self):
        numbers = (100, 101, 102) if self.trainer.global_rank == 0 else (102,)
        frames = [toy_batch([0, 1], [number == 100] * 2, number) for number in numbers]
        for frame in frames:
            frame.skipped["RADAR_LEFT_FRONT"] = 1
        return DataLoader(frames, batch_size=None)


def toy_module(module_class=TemporalModule, seed=0):
    torch.manual_seed(seed)
    optim = OptimConfig(
        lr=1e-2, weight_decay=0.01, clip_norm=35.0, peak_lr_ratio=10.0, final_lr_ratio=1e-4, rise_fraction=0.4,
        betas=[0.95, 0.99], cycled_beta1=[0.95, 0.85], ema_decay=None,
    )  # fmt: skip
    return module_class(
        ToyDetector(),
        optim=optim,
        backbone_lr_multiplier=1.0,
        evaluator=DetectionEvaluator(toy_evaluation_set()),
        seed=seed,
        config={"model": {"name": "toy"}},
    )


def toy_trainer(
    folder, resume=None, *, epochs=EPOCHS, validate_every=1, ema=None, every_steps=None, ranks=1, precision="32-true"
):
    """A Trainer on the CPU for this module, without a progress bar."""
    config = TrainerConfig(
        accelerator=Accelerator.cpu, devices=ranks, num_nodes=1, log_every_steps=1, checkpoint_every_steps=every_steps,
        num_pictures=0, on_nonfinite=OnNonfinite.stop, deterministic=False,
    )  # fmt: skip
    phase = PhaseConfig(
        name="toy", module="TemporalModule", task="detection", monitor="val/mAP", temporal=True, init_from=None,
        train_missing=False, frozen_statistics=False, epochs=epochs, validate_every=validate_every, long_range=None,
        options={},
    )  # fmt: skip
    loggers = build_loggers(folder, resume, None) if is_main_process() else []
    trainer = build_trainer(folder, config, phase, precision=precision, ema_decay=ema, loggers=loggers)
    trainer.progress_bar_callback.disable()
    return trainer


def train_toy(folder, module, data, **options):
    """Train in a run's folder, from its newest checkpoint where there is one; `options` are those of `toy_trainer`."""
    if is_main_process():
        folder.open(Resume.auto)
    resume_from = folder.newest_checkpoint()
    try:
        fit(toy_trainer(folder, resume_from, **options), module, data, resume_from)
    finally:
        if is_main_process():
            folder.close()
