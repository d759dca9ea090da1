"""suite=soak: memory, time and handles over thousands of streamed frames, in inference and in phase-2 training.

What grows with the number of frames ends a long drive or a training of days, however slowly it grows.
"""

from __future__ import annotations

import ctypes
import gc
import itertools
import math
import multiprocessing
import os
import statistics
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from src.assembly import build_datamodule, build_module, data_root
from src.benchmark.cases import KEY_FRAME_S, measured_detector, measured_model, remembering
from src.benchmark.page import page_name
from src.benchmark.parts import tensors_in, wrapped_parts
from src.benchmark.plots import draw_soak
from src.benchmark.timing import clock, median_iqr, status_bytes, trim_heap
from src.config import Config
from src.data.datamodule import DetectionDataModule
from src.errors import ConfigError
from src.geometry.tensor_transforms import invert_rigid
from src.streaming import StreamingDetector
from src.structures.batch import FrameBatch
from src.training.fit import build_loggers, build_trainer, fit
from src.training.run_folder import Resume, RunFolder

FRAMES = {"paper": 2000, "mini": 960, "debug": 120}
"""Frames of each of the three passes, by scale; training rounds up to whole epochs. On two cores mini takes 15 min."""
POINTS = 32  # of each curve
SETTLED = 0.25  # growth counts from here on: by then buffers have their size and the allocator its pages
UNLEARNED = 1e-12  # learning rate: every step is made, but the work of a frame does not follow what is learned

DRIVE, CLIPS, TRAINING = "inference, one drive", "inference, clip by clip", "training"
Row = dict[str, Any]


def measure(config: Config, tree: dict[str, Any]) -> dict[str, Any]:
    """Curves over three long passes, after how much each quantity grows; see `Curve` for what is measured.

    Raises ConfigError for a phase without memory.
    """
    if not config.phase.temporal:
        raise ConfigError(f"suite=soak streams with memory, but phase={config.phase.name} has none; give phase=phase2")
    device = config.trainer.device()
    config = replace(config, optim=replace(config.optim, lr=UNLEARNED))
    if config.checkpoint is None:
        config = remembering(config)
    datamodule = build_datamodule(config, data_root(config))
    frames, curves = FRAMES[config.scale], {}
    for name in (DRIVE, CLIPS):
        detector = measured_detector(config, datamodule.settings, next(datamodule.stream()))
        curves[name] = soak_inference(detector, datamodule, frames, one_drive=name == DRIVE)
        del detector
    curves[TRAINING] = soak_training(config, tree, datamodule, frames, device)
    epoch = epoch_frames(config, datamodule)
    validated = epoch * config.phase.validate_every  # frames before the first validation
    enough = validated + 2 * epoch <= curves[TRAINING][-1]["frames"]
    growth = [growth_row(name, curves[name]) for name in (DRIVE, CLIPS)]
    growth.append(growth_row(TRAINING, curves[TRAINING], epoch, validated if enough else 0))
    result = {
        "notes": [
            f"{config.model.name}, {config.phase.name}, scale {config.scale}, {config.precision} on {device}, "
            + (f"weights of {Path(config.checkpoint).name}. " if config.checkpoint else "fresh weights. ")
            + f"Growth is the median slope between all points (Theil-Sen) behind the first {SETTLED:.0%} of a pass; in "
            "training between points at the same place of two epochs, behind the first validation (which starts its "
            "own loader) where two epochs follow it. `last / second quarter` compares the median times of a frame, "
            "from one frame to the next with reading.",
            f"{DRIVE}: validation clips joined end to end, time and pose go on, so the memory is never empty. "
            f"{CLIPS}: each clip starts anew, as in validation. {TRAINING}: the run that this configuration would "
            f"train, batches of {config.data.batch_size} from its loader, with trainer, logs, validations and "
            f"checkpoints, at a learning rate of {UNLEARNED:g}: every step is made, but what a frame costs does not "
            "follow what is learned. Validations lie between the frames that are counted and timed.",
            "RSS: pages that the process holds. heap: of them what is in use now (glibc); the rest is kept for reuse. "
            "workers: RSS of the loader's processes, with pages that they share. remembered: what the memory keeps. "
            "tensors and objects: those of Python's garbage collector, which runs as it always does.",
        ],
        "picture": None,
        "growth": growth,
    }
    if config.out:
        name = f"{page_name(config)}.png"
        draw_soak(Path(config.out) / name, curves, f"Long runs, {config.model.name}, scale {config.scale}")
        result["picture"] = name
    return result | curves


# ---------------------------------------------------------------- the three passes


def soak_inference(
    detector: StreamingDetector, datamodule: DetectionDataModule, frames: int, one_drive: bool
) -> list[Row]:
    """The curve of so many validation frames, read and detected one by one."""
    source = itertools.chain.from_iterable(datamodule.stream() for _ in itertools.count())
    if one_drive:
        source = joined(source)
    curve = Curve(frames, detector.device, lambda: detector.memory)
    curve.begin()
    for frame in itertools.islice(source, frames):
        detector.step(frame)
        curve.passed(1)
    return curve.rows


def joined(
    frames: Iterator[FrameBatch],  # clip after clip, batches of one
) -> Iterator[FrameBatch]:
    """The clips as one drive: each starts where the one before would have arrived at its last speed."""
    onward = torch.eye(4, dtype=torch.float64)[None]  # joined from own global frame
    later_s, step, step_s = 0.0, onward, KEY_FRAME_S
    before: FrameBatch | None = None
    for frame in frames:
        if before is not None and bool(frame.starts[0]):
            onward = made_rigid(before.global_from_ego @ step @ invert_rigid(frame.global_from_ego))
            later_s = before.timestamps_s + step_s - frame.timestamps_s
        moved = replace(
            frame,
            global_from_ego=onward @ frame.global_from_ego,
            timestamps_s=frame.timestamps_s + later_s,
            starts=torch.tensor([before is None]),
        )
        if before is not None:
            step = invert_rigid(before.global_from_ego) @ moved.global_from_ego
            step_s = moved.timestamps_s - before.timestamps_s
        before = moved
        yield moved


def made_rigid(
    matrix: Tensor,  # [1, 4, 4] rigid but for rounding
) -> Tensor:  # [1, 4, 4]
    """The transform with the nearest rotation, so that rounding errors do not grow from joint to joint."""
    left, _, right = torch.linalg.svd(matrix[:, :3, :3])
    rigid = matrix.clone()
    rigid[:, :3, :3] = left @ right
    return rigid


def soak_training(
    config: Config, tree: dict[str, Any], datamodule: DetectionDataModule, frames: int, device: torch.device
) -> list[Row]:
    """The curve of a training of so many frames, rounded up to whole epochs, in a folder that is removed again."""
    torch.manual_seed(config.seed)
    module = build_module(config, tree, datamodule, measured_model(config))
    epochs = math.ceil(frames / epoch_frames(config, datamodule))
    curve = Curve(frames, device, lambda: [memory for _, memory in module.memories])

    def watched(name: str, method: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            result = method(*arguments, **named)
            if name == "epoch":  # before it came a validation and a checkpoint
                curve.begin()
            else:
                curve.passed(config.data.batch_size)
            return result

        return call

    with tempfile.TemporaryDirectory() as place:
        folder = RunFolder(Path(place), "soak")
        folder.open(Resume.auto)
        trainer = build_trainer(
            folder,
            replace(config.trainer, devices=1),
            replace(config.phase, epochs=epochs),
            precision=config.precision,
            ema_decay=config.optim.ema_decay,
            loggers=build_loggers(folder, None, None),
        )
        hooks = {"epoch": ("on_train_epoch_start",), "step": ("on_train_batch_end",)}
        with wrapped_parts(module, hooks, watched):
            fit(trainer, module, datamodule, None)
    return curve.rows


def epoch_frames(config: Config, datamodule: DetectionDataModule) -> int:
    """Frames of a training epoch."""
    return len(datamodule.train_dataloader()) * config.data.batch_size


# ---------------------------------------------------------------- what is measured


class Curve:
    """What the process holds and how long a frame takes, measured `POINTS` times over so many frames.

    A row has `frames` passed so far, `ms` a frame, the median since the row before (± its interquartile range), then
    what `held` gives. Neither that measurement nor what lies between `passed` and the next `begin` is in the times.
    """

    def __init__(self, frames: int, device: torch.device, memory: Callable[[], Any]) -> None:
        self.rows: list[Row] = []
        self._every, self._device, self._memory = frames / POINTS, device, memory
        self._now, self._since, self._frames = clock(device), 0.0, 0
        self._times: list[float] = []
        # Where a leak could hide for long: what earlier work left to the allocators.
        gc.collect()
        if torch.cuda.is_available():
            torch.cuda.empty_cache()
        trim_heap()

    def begin(self) -> None:
        """A frame begins now."""
        self._since = self._now()

    def passed(self, frames: int) -> None:
        """So many frames have passed since `begin`, or since the last call; the next begins."""
        self._times.append(1e3 * (self._now() - self._since) / frames)
        self._frames += frames
        if self._frames >= self._every * (len(self.rows) + 1) - 1e-6:
            middle, iqr = median_iqr(self._times)
            self._times.clear()
            row = {"frames": self._frames, "ms": middle, "± ms": iqr}
            self.rows.append(row | held(self._device, self._memory()))
        self.begin()


def held(device: torch.device, memory: Any) -> Row:
    """What the process holds now, MiB and numbers; without what this system does not report."""
    objects = gc.get_objects()
    resident = status_bytes("VmRSS")
    workers = [status_bytes("VmRSS", worker.pid) for worker in multiprocessing.active_children()]
    storages = [tensor.untyped_storage() for tensor in tensors_in(memory)]  # a small view can hold a large tensor
    kept = {storage.data_ptr(): storage.nbytes() for storage in storages}
    row = {
        "RSS MiB": None if resident is None else resident / 2**20,
        "heap MiB": heap_mib(),
        "workers MiB": sum(workers) / 2**20 if workers and None not in workers else None,
        "CUDA MiB": torch.cuda.memory_allocated() / 2**20 if device.type == "cuda" else None,
        "CUDA reserved MiB": torch.cuda.memory_reserved() / 2**20 if device.type == "cuda" else None,
        "remembered MiB": sum(kept.values()) / 2**20,
        "tensors": sum(issubclass(type(value), Tensor) for value in objects),
        "objects": len(objects),
        "descriptors": number_in("/proc/self/fd"),
        "threads": number_in("/proc/self/task"),
    }
    return {name: value for name, value in row.items() if value is not None}


class _Mallinfo(ctypes.Structure):
    """glibc's `struct mallinfo2`."""

    _fields_ = [("counts", 10 * ctypes.c_size_t)]  # hblkhd, of mappings, is the fifth; uordblks, of arenas, the eighth


def heap_mib() -> float | None:
    """What the C allocator has given out and not got back, in all its arenas and mappings (glibc from 2.33)."""
    mallinfo = getattr(ctypes.CDLL(None), "mallinfo2", None)
    if mallinfo is None:
        return None
    mallinfo.restype = _Mallinfo
    counts = mallinfo().counts
    return (counts[4] + counts[7]) / 2**20


def number_in(folder: str) -> int | None:
    """Entries of a folder, None where it does not exist."""
    return len(os.listdir(folder)) if os.path.isdir(folder) else None


# ---------------------------------------------------------------- growth


def growth_row(
    name: str,
    rows: list[Row],
    period: int = 1,  # frames after which the work is the same again
    settled_after: int = 0,  # frames, where that is more than SETTLED of all
) -> Row:
    """How much everything grows in a thousand frames once it has settled, and the times of two quarters.

    Within a training epoch the clips' memories fill, so only points at the same place of two epochs show growth.
    """
    last_frame = rows[-1]["frames"]
    settled = [row for row in rows if row["frames"] > max(SETTLED * last_frame, settled_after)]
    second = [row["ms"] for row in rows if SETTLED * last_frame < row["frames"] <= 0.5 * last_frame]
    last = [row["ms"] for row in rows if row["frames"] > 0.75 * last_frame]
    pairs = []  # whole periods apart, as nearly as the spacing of the points can tell
    for before, after in itertools.combinations(settled, 2):
        apart = after["frames"] - before["frames"]
        if apart >= period and abs(apart - period * round(apart / period)) < 0.5 * last_frame / len(rows):
            pairs.append((before, after))
    growth = {
        f"{quantity} / 1000 frames": 1e3 * robust_slope(pairs, quantity)
        for quantity in rows[-1]
        if pairs and quantity not in ("frames", "ms", "± ms") and all(quantity in row for row in settled)
    }
    ratio = {"last / second quarter": statistics.median(last) / statistics.median(second)}
    return {"pass": name, "frames": last_frame} | ratio | growth


def robust_slope(
    pairs: list[tuple[Row, Row]],  # the earlier first
    quantity: str,
) -> float:
    """Median of the slopes between pairs of points (Theil 1950, Sen 1968): up to 29 % of outliers do not matter."""
    return statistics.median((b[quantity] - a[quantity]) / (b["frames"] - a["frames"]) for a, b in pairs)
